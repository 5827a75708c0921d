// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>

namespace vla::kernels {

/// Copies words of four bytes: rows of shape[0] words, in up to five more dimensions. Strides are in words. The words
/// of a result's row are contiguous.
struct CopyJob {
  using Extents = std::array<std::int64_t, 6>;

  const std::uint32_t* from;
  std::uint32_t* to;
  Extents shape, from_stride, to_stride;

  std::int64_t n_row() const { return shape[1] * shape[2] * shape[3] * shape[4] * shape[5]; }

  void copy_rows(std::int64_t begin, std::int64_t end) const {
    Extents at = {};  // the row's index in each dimension
    std::int64_t rest = begin;
    for (std::size_t i = 1; i < at.size(); ++i) at[i] = rest % shape[i], rest /= shape[i];
    for (std::int64_t row = begin; row < end; ++row) {
      copy_row(from + place(from_stride, at), to + place(to_stride, at));
      for (std::size_t i = 1; i < at.size() && ++at[i] == shape[i]; ++i) at[i] = 0;
    }
  }

 private:
  static std::int64_t place(const Extents& stride, const Extents& at) {
    std::int64_t sum = 0;
    for (std::size_t i = 1; i < at.size(); ++i) sum += at[i] * stride[i];
    return sum;
  }
  void copy_row(const std::uint32_t* from_row, std::uint32_t* to_row) const {
    if (from_stride[0] == 1)
      std::memcpy(to_row, from_row, static_cast<std::size_t>(shape[0]) * sizeof(std::uint32_t));
    else
      for (std::int64_t i = 0; i < shape[0]; ++i) to_row[i] = from_row[i * from_stride[0]];
  }
};

}  // namespace vla::kernels
