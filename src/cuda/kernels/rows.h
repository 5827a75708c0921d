// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/kernels/linear_bf16.h"

/// Kernels that work on one row at a time: norms, codes, rotations and table lookups.
namespace vla::cuda {

enum class RowNorm { none, layer, rms };
/// Formats of y: float32, bf16, or int8 codes as in kernels/quantized.h.
enum class RowType { f32, bf16, codes };

/// y = norm(x + residual), row by row.
struct NormJob {
  const float* x;              // n_row rows of n values with stride x_stride
  const float* residual;       // n_row contiguous rows of n values, or null
  float* sum;                  // receives x + residual, in the residual's layout, or null
  const float *weight, *bias;  // [n], or null
  void* y;                     // rows with stride y_stride, in elements, or in bytes for codes
  std::int64_t x_stride, y_stride;
  int n_row, n;
  float eps;
  RowNorm norm;
  RowType type;
};
constexpr int kMaxKept = 24576;  // wider rows are read again; narrower ones stay in shared memory
/// From kManyRows rows on, of up to kOfWarp values, each warp norms a row without block barriers.
constexpr int kManyRows = 1024, kOfWarp = 1024, kRowsOfBlock = 4;
inline bool is_aligned(const void* p) { return reinterpret_cast<std::uint64_t>(p) % 16 == 0; }
/// Whether rows consist of aligned fours.
inline bool is_whole(const NormJob& job) {
  return (job.n | job.x_stride | job.y_stride) % 4 == 0 && is_aligned(job.x) && is_aligned(job.residual) &&
         is_aligned(job.sum) && is_aligned(job.weight) && is_aligned(job.bias) && is_aligned(job.y);
}
inline Launch norm_rows(const NormJob& job) {
  const auto n_row = static_cast<unsigned>(job.n_row);
  if (!is_whole(job) || job.n > 8192) {
    const int n_kept = job.n <= kMaxKept ? job.n : 0;
    return {"norm_rows", {n_row}, 256, static_cast<unsigned>(n_kept * 4 + 64)};
  }
  if (job.n_row >= kManyRows && job.n <= kOfWarp && job.type != RowType::codes)
    return {"norm_many_rows", {blocks(job.n_row, kRowsOfBlock)}, 32 * kRowsOfBlock};
  if (job.n > 4096) return {"norm_rows_8", {n_row}, 512, 256};
  return {job.n <= 2048 ? "norm_rows_2" : "norm_rows_4", {n_row}, 256, 256};
}

/// y = norm(v), where v is a product of up to kMostFinished columns whose depth is split into up to kMostSplits shares.
/// Adds the shares as finish_bf16_partial does, for an epilogue without activation, gate and final ReLU. norm.sum
/// receives v. Rows consist of aligned fours.
struct FinishNormJob {
  LinearBf16Job product;
  NormJob norm;  // without x and residual
};
constexpr int kMostFinished = 2048;
inline bool is_whole(const FinishNormJob& job) {
  const Epilogue& end = job.product.end;
  return is_whole(job.norm) && is_aligned(job.product.partial) && is_aligned(end.bias) && is_aligned(end.factor) &&
         is_aligned(end.residual);
}
inline Launch finish_norm_rows(const FinishNormJob& job) {
  return {job.norm.n <= 1024 ? "finish_norm_rows_1" : "finish_norm_rows_2",
          {static_cast<unsigned>(job.norm.n_row)},
          256,
          256};
}

/// Rows of heads: an RMS norm over the head if there is a weight, then a rotation of the pairs (x_i, x_{i + d_head/2})
/// if there is a table.
struct HeadJob {
  const float* x;
  void* y;                                // float32 or bf16
  const float* weight;                    // [d_head], or null
  const float* table;                     // [d_head, n_token]: cosines, then sines of each token; or null
  std::int64_t x_head, x_token, x_batch;  // strides of heads, tokens and batches in elements
  std::int64_t y_head, y_token, y_batch;
  int d_head, n_head, n_token, n_batch;
  float eps;
  bool is_bf16;
};
inline Launch head_rows(const HeadJob& job) {
  return {"head_rows", {blocks(static_cast<std::int64_t>(job.n_head) * job.n_token * job.n_batch, 4)}, 128};
}

inline Launch several_head_rows(Several<HeadJob>& jobs) {
  return {"several_head_rows", {fill_ends(jobs, [](const HeadJob& one) { return head_rows(one).grid.x; })}, 128};
}

enum class TableType { f32, f16, bf16 };
/// Looks up rows of a table. An id out of range gives a row of NaN; callers check ids before the launch.
struct LookupJob {
  const void* table;  // n_table rows of n
  const std::int32_t* ids;
  float* y;  // n_row rows of n
  int n_row, n_table, n;
  TableType type;
};
constexpr int kLookupBlock = 1024;  // elements of a row that a block looks up
inline Launch lookup_rows(const LookupJob& job) {
  return {"lookup_rows", {static_cast<unsigned>(job.n_row), blocks(job.n, kLookupBlock)}, 128};
}

}  // namespace vla::cuda
