// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cmath>

#include "processor/resample.h"

namespace vla {
namespace {

constexpr float kOne = 2048.0f;  // a weight of 1

/// One output position along one axis: two source positions and their weights.
struct Tap {
  int low, high;
  int low_weight, high_weight;
};

/// `columns`: a position beyond the edge takes the edge alone. Rows there are blended with themselves, which loses a
/// digit now and then.
std::vector<Tap> make_taps(int n_in, int n_out, bool columns) {
  const double scale = 1.0 / (static_cast<double>(n_out) / n_in);
  std::vector<Tap> taps;
  taps.reserve(static_cast<std::size_t>(n_out));
  for (int i = 0; i < n_out; ++i) {
    const auto source = static_cast<float>((i + 0.5) * scale - 0.5);
    const int low = static_cast<int>(std::floor(source));
    float fraction = source - static_cast<float>(low);
    if (columns && (low < 0 || low >= n_in - 1)) fraction = 0.0f;
    taps.push_back({std::clamp(low, 0, n_in - 1), std::clamp(low + 1, 0, n_in - 1),
                    static_cast<int>(std::nearbyint((1.0f - fraction) * kOne)),
                    static_cast<int>(std::nearbyint(fraction * kOne))});
  }
  return taps;
}

/// One row of the picture at its new width; numbers are 2048 times as large as bytes.
void widen(const std::uint8_t* row, const std::vector<Tap>& columns, int* out) {
  for (const Tap& tap : columns)
    for (int c = 0; c < 3; ++c)
      *out++ = row[3 * tap.low + c] * tap.low_weight + row[3 * tap.high + c] * tap.high_weight;
}

std::uint8_t blended(int top, int top_weight, int bottom, int bottom_weight) {
  const int sum = ((top >> 4) * top_weight >> 16) + ((bottom >> 4) * bottom_weight >> 16);
  return static_cast<std::uint8_t>(std::clamp((sum + 2) >> 2, 0, 255));
}

std::vector<std::uint8_t> halved(std::span<const std::uint8_t> rgb, int to_width, int to_height) {
  const auto out_row = static_cast<std::size_t>(to_width) * 3, in_row = 2 * out_row;
  std::vector<std::uint8_t> out;
  out.reserve(out_row * static_cast<std::size_t>(to_height));
  for (std::size_t y = 0; y < static_cast<std::size_t>(to_height); ++y)
    for (std::size_t i = 0; i < out_row; ++i) {
      const std::uint8_t* pixel = rgb.data() + 2 * y * in_row + i / 3 * 6 + i % 3;
      out.push_back(static_cast<std::uint8_t>((pixel[0] + pixel[3] + pixel[in_row] + pixel[in_row + 3] + 2) >> 2));
    }
  return out;
}

}  // namespace

std::vector<std::uint8_t> resample_opencv(std::span<const std::uint8_t> rgb, int width, int height, int to_width,
                                          int to_height) {
  if (width == to_width && height == to_height) return {rgb.begin(), rgb.end()};
  if (width == 2 * to_width && height == 2 * to_height) return halved(rgb, to_width, to_height);
  const std::vector<Tap> columns = make_taps(width, to_width, true), rows = make_taps(height, to_height, false);
  const std::size_t in_row = static_cast<std::size_t>(width) * 3, out_row = static_cast<std::size_t>(to_width) * 3;
  std::vector<std::uint8_t> out(out_row * static_cast<std::size_t>(to_height));
  std::vector<int> wide[2] = {std::vector<int>(out_row), std::vector<int>(out_row)};
  int held[2] = {-1, -1};  // the source rows that `wide` holds, each under the parity of its number
  const auto row_of = [&](int y) {
    const std::size_t slot = static_cast<std::size_t>(y) % 2;
    if (held[slot] != y) widen(rgb.data() + static_cast<std::size_t>(y) * in_row, columns, wide[slot].data());
    held[slot] = y;
    return wide[slot].data();
  };
  std::uint8_t* target = out.data();
  for (const Tap& row : rows) {
    const int *top = row_of(row.low), *bottom = row_of(row.high);
    for (std::size_t i = 0; i < out_row; ++i) *target++ = blended(top[i], row.low_weight, bottom[i], row.high_weight);
  }
  return out;
}

}  // namespace vla
