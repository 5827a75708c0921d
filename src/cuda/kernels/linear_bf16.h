// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/kernels/epilogue.h"
#include "cuda/kernels/launch.h"

/// Products of rows and a bf16 matrix with sums in float32, and the epilogue. Tensor cores take rows of bf16. For few
/// rows x stays float32, since rounding it would save nothing.
namespace vla::cuda {

struct LinearBf16Job {
  // n_row rows with stride x_stride: float32 for few rows, else bf16 with a stride that is a multiple of 8
  const void* x;
  const std::uint16_t* weight;  // n_column rows with stride weight_stride, a multiple of 8
  std::int64_t x_stride, weight_stride;
  int n_row, n_column, depth;  // elements of a row after the depth are ignored
  /// With more than one split, sums over a share of the depth go to partial [n_column, n_row, n_split];
  /// `finish_bf16_partial` adds them in order and computes y.
  int n_split;
  float* partial;
  Epilogue end;
};

/// Rows of a block on tensor cores; few: up to kBf16FewRows rows in all, where reading the matrix once is the
/// bottleneck. A strip has so many columns of up to 64 rows, in which a block has much of the depth on its way at once;
/// depths are multiples of 8.
enum class Bf16Shape { few, strip16, strip32, strip64, rows64, rows128 };
constexpr int kBf16FewRows = 8;
constexpr int kBf16Depth = 32;  // step of the depth, and unit of a split

constexpr bool is_strip(Bf16Shape shape) {
  return shape == Bf16Shape::strip16 || shape == Bf16Shape::strip32 || shape == Bf16Shape::strip64;
}

inline Launch linear_bf16(Bf16Shape shape, const LinearBf16Job& job) {
  const auto splits = static_cast<unsigned>(job.n_split);
  if (shape == Bf16Shape::few)
    return {"linear_bf16_few", {blocks(job.n_column, 8), blocks(job.n_row, kBf16FewRows), splits}, 128};
  if (is_strip(shape)) {
    const unsigned columns = shape == Bf16Shape::strip16 ? 16 : shape == Bf16Shape::strip32 ? 32 : 64;
    const char* name = columns == 16 ? "linear_strip_16" : columns == 32 ? "linear_strip_32" : "linear_strip_64";
    const unsigned n_sum = columns == 64 ? 4 : 8;  // of warps that share columns
    return {name, {blocks(job.n_column, columns), blocks(job.n_row, 64), splits}, 256, n_sum * 64 * (columns + 8) * 4};
  }
  const unsigned size = shape == Bf16Shape::rows64 ? 64 : 128;
  return {shape == Bf16Shape::rows64 ? "linear_bf16_64" : "linear_bf16_128",
          {blocks(job.n_column, size), blocks(job.n_row, size), splits},
          128,
          4 * 2 * size * kBf16Depth * 2};
}
inline Launch finish_bf16_partial(const LinearBf16Job& job) {
  return {"linear_bf16_finish", {blocks(job.n_column, 256), static_cast<unsigned>(job.n_row)}, 128};
}

}  // namespace vla::cuda
