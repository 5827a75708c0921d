// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <sys/mman.h>
#include <unistd.h>

#include <cmath>

#include "engine/engine.h"
#include "fuzz/budget.h"
#include "fuzz/bundle_target.h"

namespace vla::fuzz {

/// An observation of the right names and sizes: views half grey, states 0.1, a sentence.
inline Observation plain_observation(const Processor& processor, int width = 24, int height = 24) {
  Observation observation;
  const auto n_byte = static_cast<std::size_t>(width) * static_cast<std::size_t>(height) * 3;
  const Frame grey{width, height, std::vector<std::uint8_t>(n_byte, 128)};
  for (const std::string& view : processor.views().names()) observation.views.emplace(view, grey);
  for (std::size_t i = 0; i < processor.states().names().size(); ++i)
    observation.states.emplace(processor.states().names()[i],
                               std::vector<float>(static_cast<std::size_t>(processor.state_dims()[i]), 0.1f));
  observation.text = "pick up the cube";
  return observation;
}

/// One act of one robot. Aborts when it is refused for a reason that no bundle can be, or answers with numbers that are
/// not finite. Returns whether it answered.
inline bool check_robot(Engine& engine, const Robot& robot) {
  const auto act = [&](auto... size) {
    Observation observation = plain_observation(robot.processor(), size...);
    observation.embodiment = robot.bundle().embodiment();
    return engine.act(observation, std::uint64_t{1});
  };
  auto chunk = act();
  // Some policies take the images of one camera or of one aspect only, which roundings between two sizes may change.
  for (const char* expected : {"an image of %d x %d", "an image with the aspect of %d x %d"})
    for (const int wider : {0, -1}) {
      int width = 0, height = 0;
      if (!chunk && std::sscanf(chunk.error().expected.c_str(), expected, &width, &height) == 2)
        chunk = act(width + wider, height);
    }
  if (!chunk) {
    const Code code = chunk.error().code;
    if (code != Code::bad_observation && code != Code::bad_action && code != Code::unsupported)
      unexpected(chunk.error());
    return false;
  }
  for (const float number : chunk->actions)
    if (!std::isfinite(number)) std::abort();
  return true;
}

/// Loads a bundle with the checksum that fits it and lets each of its robots act once. Aborts when it is refused for a
/// reason that no bundle can be. Returns whether all answered.
inline bool check_act(const std::string& bytes) {
  const Budget budget(20, 1024);
  const std::string fitted = sealed(bytes);
  const int file = ::memfd_create("fuzzed bundle", MFD_CLOEXEC);
  if (file < 0 || ::write(file, fitted.data(), fitted.size()) != static_cast<ssize_t>(fitted.size())) std::abort();
  const auto engine = Engine::load("/proc/self/fd/" + std::to_string(file), {.n_thread = 1, .all_robots = true});
  ::close(file);
  if (!engine) {
    if (engine.error().code != Code::out_of_memory) check_error(engine.error());
    return false;
  }
  bool answered = true;
  for (const Robot* robot : (*engine)->robots()) answered &= check_robot(**engine, *robot);
  return answered;
}

}  // namespace vla::fuzz
