// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cmath>

#include "processor/resample.h"

namespace vla {
namespace {

/// Keys' cubic with a = -0.5, as the compiler fuses it there.
float cubic(float distance) {
  const float x = std::abs(distance);
  if (x < 1.0f) return std::fma(std::fma(1.5f, x, -2.5f) * x, x, 1.0f);
  if (x < 2.0f) return std::fma(std::fma(x - 5.0f, x, 8.0f), x, -4.0f) * -0.5f;
  return 0.0f;
}

/// The source positions that one output position sums, and their weights.
struct Window {
  int first;
  std::vector<float> weights;
};

/// float and double are mixed as the reference mixes them.
std::vector<Window> make_windows(int n_in, int n_out) {
  const float scale = static_cast<float>(n_in) / static_cast<float>(n_out);
  const double wide_scale = static_cast<double>(scale);
  const float support = scale >= 1.0f ? static_cast<float>(2.0 * wide_scale) : 2.0f;
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
      window.weights.push_back(cubic(static_cast<float>(distance * static_cast<double>(inverse))));
      sum += window.weights.back();
    }
    for (float& weight : window.weights) weight = sum != 0.0f ? weight / sum : weight;
    windows.push_back(std::move(window));
  }
  return windows;
}

/// Positions are `step` numbers apart. Behind the first product the compiler takes four at once and adds them one by
/// one; what is left is fused.
inline __attribute__((always_inline)) float sum_of(const float* x, std::size_t step,
                                                   const std::vector<float>& weights) {
  float sum = x[0] * weights[0];
  const std::size_t n_plain = (weights.size() - 1) / 4 * 4;
  for (std::size_t j = 1; j <= n_plain; ++j) {
    const float product = x[j * step] * weights[j];
    sum += product;
  }
  for (std::size_t j = n_plain + 1; j < weights.size(); ++j) sum = std::fma(x[j * step], weights[j], sum);
  return sum;
}

/// `n_line` lines of positions `step` numbers apart, lines `line_step` apart.
struct Layout {
  std::size_t n_line, step, line_step;
};

/// Three channels where pixels are the positions of a line, one where rows are.
inline __attribute__((always_inline)) void resample_lines(const float* in, Layout from, float* out, Layout to,
                                                          const std::vector<Window>& windows) {
  for (std::size_t i = 0; i < windows.size(); ++i) {
    const float* first = in + static_cast<std::size_t>(windows[i].first) * from.step;
    for (std::size_t line = 0; line < from.n_line; ++line)
      out[i * to.step + line * to.line_step] = sum_of(first + line * from.line_step, from.step, windows[i].weights);
  }
}

// As for the letterbox: without the instruction std::fma is a slow but equal library function.
#if defined(__x86_64__)
__attribute__((target("fma"))) void resample_lines_fused(const float* in, Layout from, float* out, Layout to,
                                                         const std::vector<Window>& windows) {
  resample_lines(in, from, out, to, windows);
}
#endif

void resample_axis(const float* in, Layout from, float* out, Layout to, const std::vector<Window>& windows) {
#if defined(__x86_64__)
  if (__builtin_cpu_supports("fma")) return resample_lines_fused(in, from, out, to, windows);
#endif
  resample_lines(in, from, out, to, windows);
}

std::uint8_t rounded(float x) { return static_cast<std::uint8_t>(std::nearbyint(std::clamp(x, 0.0f, 255.0f))); }

}  // namespace

std::vector<std::uint8_t> resample_torch(std::span<const std::uint8_t> rgb, int width, int height, int to_width,
                                         int to_height) {
  const std::size_t in_row = static_cast<std::size_t>(width) * 3, out_row = static_cast<std::size_t>(to_width) * 3;
  const auto n_in = static_cast<std::size_t>(height), n_out = static_cast<std::size_t>(to_height);
  std::vector<float> planes(rgb.begin(), rgb.end());
  if (to_width != width) {
    std::vector<float> wide(out_row * n_in);
    const std::vector<Window> windows = make_windows(width, to_width);
    for (std::size_t y = 0; y < n_in; ++y)
      resample_axis(planes.data() + y * in_row, {3, 3, 1}, wide.data() + y * out_row, {3, 3, 1}, windows);
    planes = std::move(wide);
  }
  if (to_height != height) {
    std::vector<float> high(out_row * n_out);
    resample_axis(planes.data(), {out_row, out_row, 1}, high.data(), {out_row, out_row, 1},
                  make_windows(height, to_height));
    planes = std::move(high);
  }
  std::vector<std::uint8_t> out(planes.size());
  std::transform(planes.begin(), planes.end(), out.begin(), rounded);
  return out;
}

}  // namespace vla
