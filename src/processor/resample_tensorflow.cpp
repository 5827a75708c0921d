// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cmath>

#include "processor/resample.h"

namespace vla {
namespace {

constexpr float kRadius = 3.0f;

/// For x >= 0. Every product and quotient is rounded to float32, in the reference's order.
float lanczos3(float x) {
  constexpr float kPi = 3.14159265359f;
  if (x > kRadius) return 0.0f;
  if (x <= 1e-3f) return 1.0f;
  return kRadius * std::sin(kPi * x) * std::sin(kPi * x / kRadius) / (kPi * kPi * x * x);
}

/// The source positions that one output position sums, with weights.
struct Window {
  int first;
  std::vector<float> weights;
};

std::vector<Window> make_windows(int n_in, int n_out) {
  const float scale = static_cast<float>(n_out) / static_cast<float>(n_in);
  const auto inverse = static_cast<float>(1.0 / static_cast<double>(scale));
  const float widened = std::max(inverse, 1.0f), narrowed = 1.0f / widened;
  std::vector<Window> windows;
  windows.reserve(static_cast<std::size_t>(n_out));
  for (int i = 0; i < n_out; ++i) {
    const float center = (static_cast<float>(i) + 0.5f) * inverse;
    const auto within = [n_in](float x) { return static_cast<int>(std::clamp(x, 0.0f, static_cast<float>(n_in - 1))); };
    Window window{within(std::ceil(center - kRadius * widened - 0.5f)), {}};
    const int last = within(std::floor(center + kRadius * widened - 0.5f));
    float sum = 0.0f;
    for (int x = window.first; x <= last; ++x) {
      window.weights.push_back(lanczos3(std::abs((static_cast<float>(x) + 0.5f - center) * narrowed)));
      sum += window.weights.back();
    }
    const float factor = 1.0f / sum;
    for (float& weight : window.weights) weight *= factor;
    windows.push_back(std::move(window));
  }
  return windows;
}

/// Calls `line` with each source position of the window and its weight.
template <class Line>
void each_weight(const Window& window, Line line) {
  for (std::size_t k = 0; k < window.weights.size(); ++k)
    line(static_cast<std::size_t>(window.first) + k, window.weights[k]);
}

std::uint8_t rounded(float x) { return static_cast<std::uint8_t>(std::clamp(std::nearbyint(x), 0.0f, 255.0f)); }

/// A position between two pixels of a line; corners map to corners.
struct Place {
  std::size_t low, high;
  float share;  // weight of the upper pixel
};

std::vector<Place> make_places(int n_in, int n_out, float begin, float end) {
  const auto last = static_cast<float>(n_in - 1);
  const float step = n_out > 1 ? (end - begin) * last / static_cast<float>(n_out - 1) : 0.0f;
  std::vector<Place> places;
  for (int i = 0; i < n_out; ++i) {
    const float x = n_out > 1 ? begin * last + static_cast<float>(i) * step : 0.5f * (begin + end) * last;
    const float low = std::floor(x);
    places.push_back({static_cast<std::size_t>(low), static_cast<std::size_t>(std::ceil(x)), x - low});
  }
  return places;
}

}  // namespace

std::vector<std::uint8_t> resample_tensorflow_lanczos3(std::span<const std::uint8_t> rgb, int width, int height,
                                                       int to_width, int to_height) {
  const std::size_t row_size = static_cast<std::size_t>(width) * 3;
  const std::vector<Window> columns = make_windows(width, to_width);
  std::vector<std::uint8_t> out;
  out.reserve(static_cast<std::size_t>(to_width) * static_cast<std::size_t>(to_height) * 3);
  std::vector<float> row(row_size);
  for (const Window& window : make_windows(height, to_height)) {
    std::fill(row.begin(), row.end(), 0.0f);
    each_weight(window, [&](std::size_t y, float weight) {
      const auto source = rgb.subspan(y * row_size, row_size);
      for (std::size_t k = 0; k < row_size; ++k) row[k] += weight * static_cast<float>(source[k]);
    });
    for (const Window& column : columns) {
      float sums[3] = {};
      each_weight(column, [&](std::size_t x, float weight) {
        for (std::size_t c = 0; c < 3; ++c) sums[c] += weight * row[3 * x + c];
      });
      for (const float sum : sums) out.push_back(rounded(sum));
    }
  }
  return out;
}

std::vector<std::uint8_t> crop_tensorflow(std::span<const std::uint8_t> rgb, int width, int height, double area,
                                          int to_width, int to_height) {
  const float side = std::sqrt(static_cast<float>(area)), begin = (1.0f - side) / 2.0f, end = begin + side;
  const std::vector<Place> rows = make_places(height, to_height, begin, end);
  const std::vector<Place> columns = make_places(width, to_width, begin, end);
  const auto pixel = [&](std::size_t y, std::size_t x, std::size_t c) {
    constexpr float kUnit = 1.0f / 255.0f;
    return static_cast<float>(rgb[(y * static_cast<std::size_t>(width) + x) * 3 + c]) * kUnit;
  };
  const auto blend = [](float low, float high, float share) { return low + (high - low) * share; };
  std::vector<std::uint8_t> out;
  out.reserve(rows.size() * columns.size() * 3);
  for (const Place& y : rows)
    for (const Place& x : columns)
      for (std::size_t c = 0; c < 3; ++c) {
        const float top = blend(pixel(y.low, x.low, c), pixel(y.low, x.high, c), x.share);
        const float bottom = blend(pixel(y.high, x.low, c), pixel(y.high, x.high, c), x.share);
        out.push_back(static_cast<std::uint8_t>(std::clamp(blend(top, bottom, y.share), 0.0f, 1.0f) * 255.5f));
      }
  return out;
}

}  // namespace vla
