// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <cstdlib>

#include "fuzz/budget.h"
#include "processor/processor.h"

namespace vla::fuzz {

/// Makes a processor of a bundle whose recipe is `recipe` and runs it on an observation, both ways. Aborts when what is
/// accepted gives other sizes than it says, or numbers that are not finite. Returns whether all of it ran.
inline bool check_recipe(const Bundle& bundle, const Observation& observation) {
  const Budget budget(10, 512);
  const auto processor = Processor::create(bundle);
  if (!processor) {
    if (processor.error().code != Code::bad_bundle) std::abort();
    return false;
  }
  const auto inputs = processor->encode(observation);
  if (!inputs) {
    if (inputs.error().code != Code::bad_observation || inputs.error().message().size() > 1 << 16) std::abort();
    return false;
  }
  const Recipe& recipe = processor->recipe();
  const auto n_pixel = static_cast<std::size_t>(inputs->n_view) * 3 * static_cast<std::size_t>(recipe.width) *
                       static_cast<std::size_t>(recipe.height);
  if (inputs->pixels.size() != n_pixel || inputs->tokens.size() > static_cast<std::size_t>(recipe.max_tokens))
    std::abort();
  for (const float number : inputs->state)
    if (!std::isfinite(number)) std::abort();
  const int d_action = *bundle.keys().integer("policy.d_action", kAnySize);
  const int horizon = 8;
  const std::vector<float> chunk(static_cast<std::size_t>(horizon * d_action), 0.5f);
  const auto actions = processor->decode(chunk, horizon, d_action, inputs->raw_state);
  if (!actions) return actions.error().code == Code::bad_action || (std::abort(), false);
  return true;
}

}  // namespace vla::fuzz
