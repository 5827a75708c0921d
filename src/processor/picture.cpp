// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/picture.h"

#include <algorithm>
#include <array>
#include <cmath>

namespace vla {
namespace {

constexpr std::size_t kChannels = 3;

/// The results of the ops for black and for white, per channel.
std::array<float, 2 * kChannels> ends_of(const Recipe& recipe, int view) {
  std::array<float, 2 * kChannels> ends = {0, 1, 0, 1, 0, 1};
  apply_ops(recipe, view, ends, 0, 2);
  return ends;
}

/// Black if both ends are equal or not finite.
std::uint8_t byte_of(float x, float black, float white) {
  const float share = (x - black) / (white - black);
  return static_cast<std::uint8_t>(share > 0 ? std::lround(255 * std::min(share, 1.0f)) : 0);
}

}  // namespace

Result<Frame> picture_of(const Processor& processor, const Frame& frame, int view) {
  const Recipe& recipe = processor.recipe();
  const std::string& name = processor.views().names()[static_cast<std::size_t>(view)];
  const std::size_t n_pixel = static_cast<std::size_t>(recipe.width) * static_cast<std::size_t>(recipe.height);
  std::vector<float> planes(kChannels * n_pixel);
  VLA_CHECK(check_frame(frame, name));
  VLA_CHECK(recipe.fit->apply(frame, view, planes, name));
  apply_ops(recipe, view, planes, 0, n_pixel);
  const std::array<float, 2 * kChannels> ends = ends_of(recipe, view);
  std::vector<std::uint8_t> rgb(planes.size());
  for (std::size_t c = 0; c < kChannels; ++c)
    for (std::size_t i = 0; i < n_pixel; ++i)
      rgb[kChannels * i + c] = byte_of(planes[c * n_pixel + i], ends[2 * c], ends[2 * c + 1]);
  return Frame{recipe.width, recipe.height, std::move(rgb)};
}

}  // namespace vla
