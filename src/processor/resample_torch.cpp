// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cmath>
#include <iterator>
#include <type_traits>

#include "processor/byte_pixels.h"
#include "processor/resample.h"

namespace vla {
namespace {

float triangle(float distance) {
  const float x = std::abs(distance);
  return x < 1.0f ? 1.0f - x : 0.0f;
}

/// Keys' cubic with a = -0.5, with the multiply-adds that torch's compiler fuses.
float cubic(float distance) {
  const float x = std::abs(distance);
  if (x < 1.0f) return std::fma(std::fma(1.5f, x, -2.5f) * x, x, 1.0f);
  if (x < 2.0f) return std::fma(std::fma(x - 5.0f, x, 8.0f), x, -4.0f) * -0.5f;
  return 0.0f;
}

/// The source positions that one output position sums, with weights.
struct Window {
  int first;
  std::vector<float> weights;
};

/// A filter and half of its width.
struct Filter {
  float (*weight)(float distance);
  double support;
};
constexpr Filter kCubic = {cubic, 2.0}, kTriangle = {triangle, 1.0};

/// Mixes float and double as the reference does.
std::vector<Window> make_windows(int n_in, int n_out, const Filter& filter) {
  const float scale = static_cast<float>(n_in) / static_cast<float>(n_out);
  const double wide_scale = static_cast<double>(scale);
  const float support = static_cast<float>(scale >= 1.0f ? filter.support * wide_scale : filter.support);
  const float inverse = scale >= 1.0f ? static_cast<float>(1.0 / wide_scale) : 1.0f;
  const int longest = static_cast<int>(std::ceil(support)) * 2 + 1;
  std::vector<Window> windows;
  windows.reserve(static_cast<std::size_t>(n_out));
  for (int i = 0; i < n_out; ++i) {
    const auto center = static_cast<float>(wide_scale * (i + 0.5));
    const int first = std::max(static_cast<int>(static_cast<double>(center - support) + 0.5), 0);
    const int end = std::min(static_cast<int>(static_cast<double>(center + support) + 0.5), n_in);
    Window window{first, {}};
    float sum = 0.0f;
    for (int x = first; x < std::min(end, first + longest); ++x) {
      const double distance = static_cast<double>(static_cast<float>(x) - center) + 0.5;
      window.weights.push_back(filter.weight(static_cast<float>(distance * static_cast<double>(inverse))));
      sum += window.weights.back();
    }
    for (float& weight : window.weights) weight = sum != 0.0f ? weight / sum : weight;
    windows.push_back(std::move(window));
  }
  return windows;
}

/// Adds `x * weight` to each element of a row.
inline __attribute__((always_inline)) void add_row(std::span<const float> x, float weight, bool fused, float* sums) {
  if (fused) {
    for (std::size_t k = 0; k < x.size(); ++k) sums[k] = std::fma(x[k], weight, sums[k]);
    return;
  }
  for (std::size_t k = 0; k < x.size(); ++k) {
    const float product = x[k] * weight;
    sums[k] += product;
  }
}

/// Sums several rows into one. torch's compiler computes the first product alone, then groups of four products, which
/// it adds one by one; the remaining products are fused.
inline __attribute__((always_inline)) void sum_of_rows(std::span<const float> in, const Window& window,
                                                       std::span<float> out) {
  const std::size_t n_plain = (window.weights.size() - 1) / 4 * 4;
  std::fill(out.begin(), out.end(), 0.0f);
  for (std::size_t j = 0; j < window.weights.size(); ++j) {
    const std::size_t row = static_cast<std::size_t>(window.first) + j;
    add_row(in.subspan(row * out.size(), out.size()), window.weights[j], j > n_plain, out.data());
  }
}

// std::fma gives the same result on all machines but is slow without the instruction (see ops/letterbox.cpp).
#if defined(__x86_64__)
__attribute__((target("fma"))) void sum_of_rows_fused(std::span<const float> in, const Window& window,
                                                      std::span<float> out) {
  sum_of_rows(in, window, out);
}
#endif

void sum_rows(std::span<const float> in, const Window& window, std::span<float> out) {
#if defined(__x86_64__)
  if (__builtin_cpu_supports("fma")) return sum_of_rows_fused(in, window, out);
#endif
  sum_of_rows(in, window, out);
}

/// Transposes pixels.
void turn(std::span<const float> rgb, std::size_t width, float* out) {
  const std::size_t height = rgb.size() / 3 / width;
  for (std::size_t y = 0; y < height; ++y)
    for (std::size_t x = 0; x < width; ++x)
      for (std::size_t c = 0; c < 3; ++c) out[(x * height + y) * 3 + c] = rgb[(y * width + x) * 3 + c];
}

/// Resizes the width. It transposes a band of rows, so that one loop over whole rows also serves columns; the band is
/// narrow enough for the cache.
std::vector<float> widened(std::span<const float> rgb, std::size_t width, std::size_t to_width, const Filter& filter) {
  constexpr std::size_t kBand = 16;
  const std::vector<Window> windows = make_windows(static_cast<int>(width), static_cast<int>(to_width), filter);
  const std::size_t height = rgb.size() / 3 / width;
  std::vector<float> out(to_width * height * 3), columns(width * kBand * 3), sums(to_width * kBand * 3);
  for (std::size_t top = 0; top < height; top += kBand) {
    const std::size_t size = 3 * std::min(kBand, height - top);  // length of a column in the band
    const std::span<float> column_in(columns.data(), size * width), column_out(sums.data(), size * to_width);
    turn(rgb.subspan(3 * top * width, size * width), width, column_in.data());
    for (std::size_t x = 0; x < to_width; ++x) sum_rows(column_in, windows[x], column_out.subspan(x * size, size));
    turn(column_out, size / 3, out.data() + 3 * top * to_width);
  }
  return out;
}

/// Rounds half to even: adding 2^23 to a value in [0, 255] rounds off its fraction. The library function would be a
/// slow call.
std::uint8_t rounded(float x) {
  constexpr float kNoFraction = 0x1p23f;
  return static_cast<std::uint8_t>(std::clamp(x, 0.0f, 255.0f) + kNoFraction - kNoFraction);
}

/// Sums columns first. `finish` converts a sum to a pixel's value.
template <class Finish>
auto resample(std::vector<float> pixels, int width, int height, int to_width, int to_height, const Filter& filter,
              Finish finish) {
  if (to_width != width)
    pixels = widened(pixels, static_cast<std::size_t>(width), static_cast<std::size_t>(to_width), filter);
  const std::size_t row_size = static_cast<std::size_t>(to_width) * 3;
  std::vector<std::invoke_result_t<Finish, float>> out;
  out.reserve(row_size * static_cast<std::size_t>(to_height));
  if (to_height == height) {
    std::transform(pixels.begin(), pixels.end(), std::back_inserter(out), finish);
    return out;
  }
  std::vector<float> row(row_size);
  for (const Window& window : make_windows(height, to_height, filter)) {
    sum_rows(pixels, window, row);
    std::transform(row.begin(), row.end(), std::back_inserter(out), finish);
  }
  return out;
}

}  // namespace

std::vector<std::uint8_t> resample_torch(std::span<const std::uint8_t> rgb, int width, int height, int to_width,
                                         int to_height) {
  if (width == to_width && height == to_height) return {rgb.begin(), rgb.end()};
  return resample({rgb.begin(), rgb.end()}, width, height, to_width, to_height, kCubic, rounded);
}

std::vector<std::uint8_t> resample_torch_linear(std::span<const std::uint8_t> rgb, int width, int height, int to_width,
                                                int to_height) {
  std::vector<float> pixels;
  pixels.reserve(rgb.size());
  for (const std::uint8_t byte : rgb) pixels.push_back(byte_table()[byte]);
  return resample(std::move(pixels), width, height, to_width, to_height, kTriangle,
                  [](float x) { return static_cast<std::uint8_t>(std::clamp(255.0f * x, 0.0f, 255.0f)); });
}

std::vector<float> resample_torch_cubic(std::vector<float> rgb, int width, int height, int to_width, int to_height) {
  return resample(std::move(rgb), width, height, to_width, to_height, kCubic, [](float x) { return x; });
}

std::vector<float> resample_torch_bilinear(std::vector<float> rgb, int width, int height, int to_width, int to_height) {
  return resample(std::move(rgb), width, height, to_width, to_height, kTriangle, [](float x) { return x; });
}

std::vector<float> resample_torch_area(std::vector<float> rgb, int width, int height, int to_width, int to_height) {
  struct Stretch {
    std::int64_t first, end;
  };
  const auto covered = [](std::int64_t i, std::int64_t n_in, std::int64_t n_out) {
    return Stretch{i * n_in / n_out, ((i + 1) * n_in + n_out - 1) / n_out};
  };
  std::vector<float> out;
  out.reserve(static_cast<std::size_t>(to_width) * static_cast<std::size_t>(to_height) * 3);
  for (int row = 0; row < to_height; ++row)
    for (int column = 0; column < to_width; ++column) {
      const Stretch y = covered(row, height, to_height), x = covered(column, width, to_width);
      for (std::int64_t c = 0; c < 3; ++c) {
        float sum = 0.0f;
        for (std::int64_t i = y.first; i < y.end; ++i)
          for (std::int64_t j = x.first; j < x.end; ++j) sum += rgb[static_cast<std::size_t>((i * width + j) * 3 + c)];
        out.push_back(sum / static_cast<float>(y.end - y.first) / static_cast<float>(x.end - x.first));
      }
    }
  return out;
}

}  // namespace vla
