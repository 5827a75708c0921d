// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/resample.h"

#include <algorithm>
#include <cmath>

namespace vla {
namespace {

/// The source positions that one output position sums, with weights times 2^bits.
struct Window {
  int first;
  std::vector<int> weights;
};

struct Windows {
  int bits;
  std::vector<Window> list;
};

/// A filter: its weight as a function of the distance, which is 0 from `support` on, and whether it is torch's.
struct Filter {
  double (*weight)(double);
  double support;
  bool torch;
};

double triangle(double distance) { return distance < 1.0 ? 1.0 - distance : 0.0; }

double cubic(double x) {
  constexpr double a = -0.5;
  if (x < 1.0) return ((a + 2.0) * x - (a + 3.0)) * x * x + 1.0;
  return x < 2.0 ? (((x - 5.0) * x + 8.0) * x - 4.0) * a : 0.0;
}

constexpr Filter kBilinear = {triangle, 1.0, false}, kBicubic = {cubic, 2.0, false}, kTorch = {cubic, 2.0, true};

int rounded_weight(double weight, int bits) {
  return static_cast<int>((weight < 0.0 ? -0.5 : 0.5) + weight * (1 << bits));
}

/// Fraction bits of weights: 32 bits minus 8 for a pixel and 2 of headroom. torch stores weights in 16 bits.
int weight_bits(double largest, const Filter& filter) {
  constexpr int kBits = 22;
  if (!filter.torch) return kBits;
  int bits = 0;
  while (bits < kBits && rounded_weight(largest, bits + 1) < 1 << 15) ++bits;
  return bits;
}

Windows make_windows(int n_in, int n_out, const Filter& filter) {
  const double scale = static_cast<double>(n_in) / n_out, widened = std::max(scale, 1.0);
  const double support = filter.support * widened;  // half of the filter's width
  std::vector<std::vector<double>> exact;
  Windows windows{0, {}};
  double largest = 0.0;
  for (int i = 0; i < n_out; ++i) {
    const double center = (i + 0.5) * scale;
    const int first = std::max(static_cast<int>(center - support + 0.5), 0);
    const int end = std::min(static_cast<int>(center + support + 0.5), n_in);
    std::vector<double> weights;
    double sum = 0.0;
    for (int x = first; x < end; ++x) {
      const double distance = std::abs((x - center + 0.5) * (1.0 / widened));
      weights.push_back(filter.weight(distance));
      sum += weights.back();
    }
    for (double& weight : weights) {
      weight = sum != 0.0 ? weight / sum : weight;
      largest = std::max(largest, weight);
    }
    windows.list.push_back({first, {}});
    exact.push_back(std::move(weights));
  }
  windows.bits = weight_bits(largest, filter);
  for (std::size_t i = 0; i < exact.size(); ++i)
    for (const double weight : exact[i]) windows.list[i].weights.push_back(rounded_weight(weight, windows.bits));
  return windows;
}

/// The layout of `n_line` lines. Positions are `step` bytes apart and have three channels; lines are `line_step` bytes
/// apart.
struct Layout {
  int n_line;
  std::size_t step, line_step;
};

void resample_axis(const std::uint8_t* in, Layout from, std::uint8_t* out, Layout to, const Windows& windows) {
  for (int line = 0; line < from.n_line; ++line) {
    const std::uint8_t* source = in + static_cast<std::size_t>(line) * from.line_step;
    std::uint8_t* target = out + static_cast<std::size_t>(line) * to.line_step;
    for (const Window& window : windows.list) {
      const int half = 1 << (windows.bits - 1);
      int sums[3] = {half, half, half};
      const std::uint8_t* pixel = source + static_cast<std::size_t>(window.first) * from.step;
      for (const int weight : window.weights) {
        for (int c = 0; c < 3; ++c) sums[c] += pixel[c] * weight;
        pixel += from.step;
      }
      for (int c = 0; c < 3; ++c) target[c] = static_cast<std::uint8_t>(std::clamp(sums[c] >> windows.bits, 0, 255));
      target += to.step;
    }
  }
}

/// An image of interleaved bytes.
struct Pixels {
  int width, height;
  std::vector<std::uint8_t> rgb;

  std::size_t row_size() const { return static_cast<std::size_t>(width) * 3; }
};

Pixels empty(int width, int height) {
  return {width, height, std::vector<std::uint8_t>(static_cast<std::size_t>(width) * 3 * height)};
}

Pixels with_width(Pixels from, int width, const Filter& filter) {
  if (width == from.width) return from;
  Pixels to = empty(width, from.height);
  resample_axis(from.rgb.data(), {from.height, 3, from.row_size()}, to.rgb.data(), {from.height, 3, to.row_size()},
                make_windows(from.width, width, filter));
  return to;
}

Pixels with_height(Pixels from, int height, const Filter& filter) {
  if (height == from.height) return from;
  Pixels to = empty(from.width, height);
  resample_axis(from.rgb.data(), {from.width, from.row_size(), 3}, to.rgb.data(), {from.width, from.row_size(), 3},
                make_windows(from.height, height, filter));
  return to;
}

/// Pillow 13.0 reorders the passes to save work, which changes bytes because the first sums are rounded. Earlier
/// releases and torch always sum rows first.
bool columns_come_first(int width, int height, int to_width, int to_height, const Filter& filter) {
  return !filter.torch && height - to_height > 2 * std::max(width - to_width, 0);
}

std::vector<std::uint8_t> resample(std::span<const std::uint8_t> rgb, int width, int height, int to_width,
                                   int to_height, const Filter& filter) {
  Pixels image{width, height, {rgb.begin(), rgb.end()}};
  const bool columns_first = columns_come_first(width, height, to_width, to_height, filter);
  if (columns_first) image = with_height(std::move(image), to_height, filter);
  image = with_width(std::move(image), to_width, filter);
  if (!columns_first) image = with_height(std::move(image), to_height, filter);
  return std::move(image.rgb);
}

}  // namespace

std::vector<std::uint8_t> resample_pillow_bilinear(std::span<const std::uint8_t> rgb, int width, int height,
                                                   int to_width, int to_height) {
  return resample(rgb, width, height, to_width, to_height, kBilinear);
}

std::vector<std::uint8_t> resample_pillow_bicubic(std::span<const std::uint8_t> rgb, int width, int height,
                                                  int to_width, int to_height) {
  return resample(rgb, width, height, to_width, to_height, kBicubic);
}

std::vector<std::uint8_t> resample_torch_16bit(std::span<const std::uint8_t> rgb, int width, int height, int to_width,
                                               int to_height) {
  return resample(rgb, width, height, to_width, to_height, kTorch);
}

}  // namespace vla
