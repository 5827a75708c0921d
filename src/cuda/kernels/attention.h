// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/kernels/launch.h"

/// softmax(q k * scale + mask) v for every query and head, without a score matrix in memory.
namespace vla::cuda {

/// Rows of d_head elements, with strides between heads, tokens and batches.
struct HeadRows {
  const void* data;
  std::int64_t head, token, batch;
};

struct AttentionJob {
  /// A segment of keys and values.
  struct Segment {
    HeadRows k, v;
    int n_key;
  };
  static constexpr int kMaxSegment = 6;

  HeadRows q;
  Segment segment[kMaxSegment];
  const float* mask;  // [n_key, n_query], any values except +infinity, or null
  void* y;            // [d_head, n_head, n_query, n_batch], float32 or bf16
  /// With more than one split each takes a share of the keys. Sums of values, and for every row its largest score and
  /// sum of weights, go to partial [d_head + 2, n_row, n_head_kv * n_batch, n_split]; `finish_attention` computes y
  /// from them.
  float* partial;
  float scale;
  int n_segment, n_query, n_head, n_head_kv, n_batch, d_head, n_split;
  bool is_bf16;  // whether y is bf16, else float32

  /// Query heads per key head. Their queries are rows of the same product.
  VLA_HOST_DEVICE int group() const { return n_head / n_head_kv; }
  VLA_HOST_DEVICE int n_row() const { return group() * n_query; }
};

constexpr int kMaxHead = 256;

/// On tensor cores: q, k and v are bf16; d_head and all strides are multiples of 8. Weights are rounded to bf16, sums
/// and softmax are float32.
inline Launch attention_bf16(const AttentionJob& job) {
  const int depth = job.d_head <= 64 ? 64 : job.d_head <= 80 ? 80 : job.d_head <= 128 ? 128 : 256;
  const char* name = depth == 64    ? "attention_bf16_64"
                     : depth == 80  ? "attention_bf16_80"
                     : depth == 128 ? "attention_bf16_128"
                                    : "attention_bf16_256";
  const int n_key = depth == 256 ? 32 : 64;  // of a tile
  return {
      name,
      {blocks(job.n_row(), 64), static_cast<unsigned>(job.n_head_kv * job.n_batch), static_cast<unsigned>(job.n_split)},
      128,
      static_cast<unsigned>((64 + 4 * n_key) * (depth * 2 + 16))};
}
/// In float32, for any d_head.
inline Launch attention_f32(const AttentionJob& job) {
  return {
      "attention_f32",
      {blocks(job.n_row(), 8), static_cast<unsigned>(job.n_head_kv * job.n_batch), static_cast<unsigned>(job.n_split)},
      256,
      static_cast<unsigned>((2 * 32 + 8) * (round_up(job.d_head, 32) + 1) * 4)};
}
inline Launch finish_attention(const AttentionJob& job) {
  return {"attention_finish", {blocks(job.n_row(), 4), static_cast<unsigned>(job.n_head_kv * job.n_batch)}, 128};
}

}  // namespace vla::cuda
