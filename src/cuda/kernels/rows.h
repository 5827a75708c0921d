// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/kernels/launch.h"

/// Kernels that take a row at a time: norms, codes, rotations, and lookups in tables.
namespace vla::cuda {

enum class RowNorm { none, layer, rms };
/// How rows leave: float32, bf16, or int8 codes as kernels/quantized.h lays them out.
enum class RowType { f32, bf16, codes };

/// y = norm(x + residual), row by row.
struct NormJob {
  const float* x;              // n_row rows of n values, x_stride elements apart
  const float* residual;       // n_row rows of n values one after the other, or null
  float* sum;                  // where x + residual goes, as residual lies, or null
  const float *weight, *bias;  // [n], or null
  void* y;                     // y_stride elements from one row to the next; bytes of codes
  std::int64_t x_stride, y_stride;
  int n_row, n;
  float eps;
  RowNorm norm;
  RowType type;
};
constexpr int kMaxKept = 24576;  // wider rows are read again where narrower ones stay in shared memory
inline Launch norm_rows(const NormJob& job) {
  const int n_kept = job.n <= kMaxKept ? job.n : 0;
  return {"norm_rows", {static_cast<unsigned>(job.n_row)}, 256, static_cast<unsigned>(n_kept * 4 + 64)};
}

/// Rows of heads: an RMS norm over the head where there is a weight, then a rotation of the pairs (x_i, x_{i +
/// d_head/2}) where there is a table.
struct HeadJob {
  const float* x;
  void* y;                                // float32 or bf16
  const float* weight;                    // [d_head], or null
  const float* table;                     // [d_head, n_token]: of a token cosines, then sines; or null
  std::int64_t x_head, x_token, x_batch;  // elements from one head, token or batch to the next
  std::int64_t y_head, y_token, y_batch;
  int d_head, n_head, n_token, n_batch;
  float eps;
  bool is_bf16;
};
inline Launch head_rows(const HeadJob& job) {
  return {"head_rows", {blocks(static_cast<std::int64_t>(job.n_head) * job.n_token * job.n_batch, 4)}, 128};
}

enum class TableType { f32, f16, bf16 };
/// Rows of a table. An id outside of it makes a row of NaN: ids are checked before they come here.
struct LookupJob {
  const void* table;  // n_table rows of n
  const std::int32_t* ids;
  float* y;  // n_row rows of n
  int n_row, n_table, n;
  TableType type;
};
inline Launch lookup_rows(const LookupJob& job) { return {"lookup_rows", {static_cast<unsigned>(job.n_row)}, 128}; }

}  // namespace vla::cuda
