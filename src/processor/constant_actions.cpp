// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/constant_actions.h"

#include <cmath>
#include <numeric>

namespace vla {

std::vector<std::string> constant_actions(const Processor& processor, int horizon, int d_action) {
  constexpr float kStill = 1e-5f;  // above the movement that the epsilon in a denominator causes
  const auto& dims = processor.state_dims();
  const std::vector<float> state(static_cast<std::size_t>(std::accumulate(dims.begin(), dims.end(), 0)));
  const auto chunk_of = [&](float value) {
    return std::vector<float>(static_cast<std::size_t>(horizon) * static_cast<std::size_t>(d_action), value);
  };
  const auto low = processor.decode(chunk_of(-1.0f), horizon, d_action, state);
  const auto high = processor.decode(chunk_of(1.0f), horizon, d_action, state);
  if (!low || !high) return {};  // a chunk of equal values is not always a valid pose
  const std::vector<std::string>& names = processor.action_names();
  std::vector<std::string> constant;
  for (std::size_t column = 0; column < names.size(); ++column) {
    bool moves = false;
    for (std::size_t i = column; i < low->size(); i += names.size()) moves |= std::abs((*high)[i] - (*low)[i]) > kStill;
    if (!moves) constant.push_back(names[column]);
  }
  return constant;
}

}  // namespace vla
