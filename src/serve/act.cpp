// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/act.h"

#include <fmt/format.h>

#include <random>

#include "processor/ops/op.h"

namespace vla::serve {

Status check_one_robot(const Engine& engine, const char* option) {
  const std::vector<const Robot*> robots = engine.robots();
  if (robots.size() == 1) return {};
  std::string tags;
  for (const Robot* robot : robots) tags += (tags.empty() ? "" : ", ") + robot->bundle().embodiment();
  return Error{Code::usage, option, "one robot", "a bundle for " + tags, "choose one with --embodiment"};
}

ActLimits act_limits(const ServerOptions& options, const Robot& robot) {
  const Processor& processor = robot.processor();
  return {.max_pixels = options.max_pixels,
          .max_text = options.max_text,
          .max_views = processor.views().names().size(),
          .horizon = robot.solver_horizon(),
          .noise_rows = robot.noise_rows(),
          .d_noise = robot.d_action_padded(),
          .d_action = static_cast<int>(processor.action_names().size()),
          .fit = processor.recipe().fit.get()};
}

Status spend(ActLimits& left, int width, int height, std::int64_t work, const std::string& where) {
  if (left.fit != nullptr) work += left.fit->work(width, height);
  if (work > left.max_pixels)
    return Error{Code::too_large, where, fmt::format("an image that costs at most {} pixels", left.max_pixels),
                 fmt::format("{} x {}, which costs {}", width, height, work), "Description.limits has all limits"};
  left.max_pixels -= work;
  return {};
}

std::uint64_t fresh_seed() {
  std::random_device device;
  return (std::uint64_t{device()} << 32) | device();
}

}  // namespace vla::serve
