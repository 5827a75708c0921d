// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

namespace vla {

/// The values byte / 255 of all bytes.
inline const std::array<float, 256>& byte_table() {
  static const std::array<float, 256> table = [] {
    std::array<float, 256> values{};
    for (std::size_t i = 0; i < values.size(); ++i) values[i] = static_cast<float>(i) / 255.0f;
    return values;
  }();
  return table;
}

/// Converts interleaved pixels to planes and applies `value` to each number.
template <class T, class Value>
void spread(std::span<const T> rgb, std::span<float> out, Value value) {
  const std::size_t size = rgb.size() / 3;
  for (std::size_t i = 0; i < size; ++i)
    for (std::size_t c = 0; c < 3; ++c) out[c * size + i] = value(rgb[3 * i + c]);
}

/// Converts interleaved bytes to planes of bytes / 255.
inline void spread_bytes(std::span<const std::uint8_t> rgb, std::span<float> out) {
  spread(rgb, out, [&table = byte_table()](std::uint8_t byte) { return table[byte]; });
}

/// Truncates 255 times each pixel in [0, 1]; recovers bytes that were divided by 255.
inline std::vector<std::uint8_t> cut_to_bytes(std::span<const float> pixels) {
  std::vector<std::uint8_t> bytes;
  bytes.reserve(pixels.size());
  for (const float value : pixels) bytes.push_back(static_cast<std::uint8_t>(255.0f * value));
  return bytes;
}

}  // namespace vla
