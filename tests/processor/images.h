// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "processor/support.h"

namespace vla::test {

/// The same image as `frame_of` in the script that wrote the expected planes.
inline Frame frame_of(int width, int height) {
  std::vector<std::uint8_t> rgb;
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x)
      for (int c = 0; c < 3; ++c)
        rgb.push_back(static_cast<std::uint8_t>((x * 7 + y * 13 + c * 29 + (x * y) % 17) % 256));
  return {width, height, std::move(rgb)};
}

inline Frame as_floats(const Frame& frame) {
  std::vector<float> values;
  for (const std::uint8_t byte : std::get<std::vector<std::uint8_t>>(frame.rgb))
    values.push_back(static_cast<float>(byte) / 255.0f);
  return {frame.width, frame.height, std::move(values)};
}

}  // namespace vla::test
