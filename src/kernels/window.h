// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <cstring>

#include "kernels/row_kernel.h"
#include "kernels/sizes.h"

namespace vla::kernels {

/// A square of `size` pixels that moves over images of d elements per pixel, image by image, in steps of `stride`, with
/// `padding` pixels on each side (op::Window). Places are numbered row by row, image by image.
struct Window {
  std::int64_t d, width, height;
  std::int64_t size, stride, padding;
  std::int64_t n_column, n_row;  // places per image

  /// Elements inside the window.
  VLA_INLINE std::int64_t width_of_place() const { return d * size * size; }

  /// Copies elements first to first + n - 1 of the window at a place: pixels row by row, zeros outside of the image.
  VLA_INLINE void copy(const float* images, std::int64_t place, std::int64_t first, std::int64_t n, float* to) const {
    const Corner corner = corner_of(place);
    const std::int64_t line = d * size, end = first + n;
    for (std::int64_t row = first / line; row * line < end; ++row) {
      const std::int64_t from = first > row * line ? first - row * line : 0, until = min(line, end - row * line);
      copy_line(images, corner, row, from, until, to);
      to += until - from;
    }
  }

  /// Writes the maximum of each feature over the window's pixels inside the image.
  VLA_INLINE void largest(RowKernel larger, const float* images, std::int64_t place, float* to) const {
    bool is_first = true;
    for_covered(images, corner_of(place), [&](const float* pixel, std::int64_t) VLA_LAMBDA {
      if (is_first)
        std::memcpy(to, pixel, static_cast<std::size_t>(d) * sizeof(float));
      else
        larger(pixel, to, nullptr, 0, to, d);
      is_first = false;
    });
  }

  /// Writes for each feature the sum of the window's pixels times that feature's weights, plus its bias.
  /// `multiply_add`: y = x * w + b.
  VLA_INLINE void weigh(RowKernel multiply_add, const float* images, const float* weight, const float* bias,
                        std::int64_t place, float* to) const {
    const float* sum = bias;
    for_covered(images, corner_of(place), [&](const float* pixel, std::int64_t i) VLA_LAMBDA {
      multiply_add(pixel, weight + i * d, sum, 0, to, d);
      sum = to;
    });
    if (sum == bias) std::memcpy(to, bias, static_cast<std::size_t>(d) * sizeof(float));
  }

 private:
  /// The pixel at the window's upper left corner, which may be outside of the image.
  struct Corner {
    std::int64_t image, x, y;
  };

  VLA_INLINE Corner corner_of(std::int64_t place) const {
    const std::int64_t n = n_column * n_row;
    return {place / n, place % n_column * stride - padding, place % n / n_column * stride - padding};
  }

  /// Calls visit(pixel, its index in the window) for pixels inside the image.
  template <class Visit>
  VLA_INLINE void for_covered(const float* images, const Corner& corner, const Visit& visit) const {
    for (std::int64_t row = max(0, -corner.y); row < min(size, height - corner.y); ++row)
      for (std::int64_t column = max(0, -corner.x); column < min(size, width - corner.x); ++column)
        visit(images + ((corner.image * height + corner.y + row) * width + corner.x + column) * d, row * size + column);
  }

  /// Copies elements `from` to `until` of a window row.
  VLA_INLINE void copy_line(const float* images, const Corner& corner, std::int64_t row, std::int64_t from,
                            std::int64_t until, float* to) const {
    const std::int64_t y = corner.y + row;
    // The row's elements that are inside the image.
    const bool inside = y >= 0 && y < height;
    const std::int64_t begin = inside ? min(until, max(from, -corner.x * d)) : until;
    const std::int64_t end = inside ? max(begin, min(until, (width - corner.x) * d)) : until;
    fill(to, begin - from);
    if (end > begin) {
      const float* line = images + ((corner.image * height + y) * width + corner.x) * d;
      std::memcpy(to + (begin - from), line + begin, static_cast<std::size_t>(end - begin) * sizeof(float));
    }
    fill(to + (end - from), until - end);
  }
  static VLA_INLINE void fill(float* to, std::int64_t n) {
    if (n > 0) std::memset(to, 0, static_cast<std::size_t>(n) * sizeof(float));
  }
};

}  // namespace vla::kernels
