// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cmath>

#include "processor/resample.h"

namespace vla {
namespace {

constexpr float kOne = 2048.0f;  // a weight of 1

/// One output position along one axis: two source positions with weights.
struct Tap {
  int low, high;
  int low_weight, high_weight;
};

/// `columns`: a position outside of the image takes only the edge pixel. Rows blend the edge row with itself, which
/// sometimes changes the last bit.
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

/// The same for INTER_AREA when an image grows: an output position inside one source position takes only that one.
std::vector<Tap> make_area_taps(int n_in, int n_out) {
  const double inverse = static_cast<double>(n_out) / n_in, scale = 1.0 / inverse;
  std::vector<Tap> taps;
  taps.reserve(static_cast<std::size_t>(n_out));
  for (int i = 0; i < n_out; ++i) {
    const int low = static_cast<int>(std::floor(i * scale));
    auto fraction = static_cast<float>((i + 1) - (low + 1) * inverse);
    fraction = fraction <= 0.0f || low >= n_in - 1 ? 0.0f : fraction - std::floor(fraction);
    taps.push_back({std::min(low, n_in - 1), std::min(low + 1, n_in - 1),
                    static_cast<int>(std::nearbyint((1.0f - fraction) * kOne)),
                    static_cast<int>(std::nearbyint(fraction * kOne))});
  }
  return taps;
}

/// Resizes one row; values are bytes times 2048.
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

std::vector<std::uint8_t> blend(std::span<const std::uint8_t> rgb, int width, const std::vector<Tap>& columns,
                                const std::vector<Tap>& rows) {
  const std::size_t in_row = static_cast<std::size_t>(width) * 3, out_row = columns.size() * 3;
  std::vector<std::uint8_t> out(out_row * rows.size());
  std::vector<int> wide[2] = {std::vector<int>(out_row), std::vector<int>(out_row)};
  int held[2] = {-1, -1};  // the source rows in `wide`, each at the parity of its index
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

/// Averages blocks of whole pixels.
std::vector<std::uint8_t> pooled(std::span<const std::uint8_t> rgb, int width, int height, int to_width,
                                 int to_height) {
  const auto n_row = static_cast<std::size_t>(height / to_height),
             n_column = static_cast<std::size_t>(width / to_width);
  const auto in_row = static_cast<std::size_t>(width) * 3, out_row = static_cast<std::size_t>(to_width) * 3;
  const float share = 1.0f / static_cast<float>(n_row * n_column);
  std::vector<std::uint8_t> out;
  out.reserve(out_row * static_cast<std::size_t>(to_height));
  std::vector<int> sums(out_row);
  for (std::size_t y = 0; y < static_cast<std::size_t>(to_height); ++y) {
    std::fill(sums.begin(), sums.end(), 0);
    for (std::size_t k = 0; k < n_row; ++k) {
      const std::uint8_t* row = rgb.data() + (y * n_row + k) * in_row;
      for (int* sum = sums.data(); sum != sums.data() + out_row; sum += 3)
        for (std::size_t i = 0; i < n_column; ++i, row += 3)
          for (std::size_t c = 0; c < 3; ++c) sum[c] += row[c];
    }
    for (const int sum : sums)
      out.push_back(static_cast<std::uint8_t>(std::nearbyint(static_cast<float>(sum) * share)));
  }
  return out;
}

/// A source position that lies partly or wholly in an output position, with its weight there.
struct Share {
  int to, from;
  float weight;
};

std::vector<Share> make_cells(int n_in, int n_out) {
  constexpr double kLeast = 1e-3;  // smallest share of a source position that counts
  const double scale = 1.0 / (static_cast<double>(n_out) / n_in);
  std::vector<Share> cells;
  for (int i = 0; i < n_out; ++i) {
    const double start = i * scale, end = start + scale, width = std::min(scale, n_in - start);
    const int last = std::min(static_cast<int>(std::floor(end)), n_in - 1);
    const int first = std::min(static_cast<int>(std::ceil(start)), last);
    if (first - start > kLeast) cells.push_back({i, first - 1, static_cast<float>((first - start) / width)});
    for (int k = first; k < last; ++k) cells.push_back({i, k, static_cast<float>(1.0 / width)});
    if (end - last > kLeast)
      cells.push_back({i, last, static_cast<float>(std::min(std::min(end - last, 1.0), width) / width)});
  }
  return cells;
}

/// Averages output cells whose borders cut through pixels: float32 sums, first along rows, then along columns.
std::vector<std::uint8_t> averaged(std::span<const std::uint8_t> rgb, int width, const std::vector<Share>& columns,
                                   const std::vector<Share>& rows) {
  const auto in_row = static_cast<std::size_t>(width) * 3;
  const auto out_row = static_cast<std::size_t>(columns.back().to + 1) * 3;
  std::vector<float> line(out_row), sums(out_row);
  std::vector<std::uint8_t> out;
  out.reserve(out_row * static_cast<std::size_t>(rows.back().to + 1));
  for (std::size_t k = 0; k < rows.size(); ++k) {
    const std::uint8_t* row = rgb.data() + static_cast<std::size_t>(rows[k].from) * in_row;
    std::fill(line.begin(), line.end(), 0.0f);
    for (const Share& column : columns)
      for (int c = 0; c < 3; ++c) {
        const float part = static_cast<float>(row[3 * column.from + c]) * column.weight;
        line[static_cast<std::size_t>(3 * column.to + c)] += part;
      }
    const bool starts = k == 0 || rows[k - 1].to != rows[k].to;
    for (std::size_t i = 0; i < out_row; ++i) {
      const float part = line[i] * rows[k].weight;
      sums[i] = starts ? part : sums[i] + part;
    }
    if (k + 1 < rows.size() && rows[k + 1].to == rows[k].to) continue;
    for (const float sum : sums)
      out.push_back(static_cast<std::uint8_t>(std::clamp(std::nearbyint(sum), 0.0f, 255.0f)));
  }
  return out;
}

}  // namespace

std::vector<std::uint8_t> resample_opencv(std::span<const std::uint8_t> rgb, int width, int height, int to_width,
                                          int to_height) {
  if (width == to_width && height == to_height) return {rgb.begin(), rgb.end()};
  if (width == 2 * to_width && height == 2 * to_height) return halved(rgb, to_width, to_height);
  return blend(rgb, width, make_taps(width, to_width, true), make_taps(height, to_height, false));
}

std::vector<std::uint8_t> resample_opencv_area(std::span<const std::uint8_t> rgb, int width, int height, int to_width,
                                               int to_height) {
  if (width == to_width && height == to_height) return {rgb.begin(), rgb.end()};
  if (width == 2 * to_width && height == 2 * to_height) return halved(rgb, to_width, to_height);
  if (width < to_width || height < to_height)
    return blend(rgb, width, make_area_taps(width, to_width), make_area_taps(height, to_height));
  if (width % to_width == 0 && height % to_height == 0) return pooled(rgb, width, height, to_width, to_height);
  return averaged(rgb, width, make_cells(width, to_width), make_cells(height, to_height));
}

}  // namespace vla
