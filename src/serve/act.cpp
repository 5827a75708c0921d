// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/act.h"

#include <random>

namespace vla::serve {

Result<const Robot*> only_robot(const Engine& engine, const char* option) {
  const std::vector<const Robot*> robots = engine.robots();
  if (robots.size() == 1) return robots[0];
  std::string tags;
  for (const Robot* robot : robots) tags += (tags.empty() ? "" : ", ") + robot->bundle().embodiment();
  return Error{Code::usage, option, "one robot", "a bundle for " + tags, "choose one with --embodiment"};
}

ActLimits act_limits(const ServerOptions& options, const Robot& robot) {
  const Processor& processor = robot.processor();
  return {options.max_pixels,     options.max_text,        processor.views().names().size(),
          robot.solver_horizon(), robot.d_action_padded(), static_cast<int>(processor.action_names().size())};
}

std::uint64_t fresh_seed() {
  std::random_device device;
  return (std::uint64_t{device()} << 32) | device();
}

}  // namespace vla::serve
