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
  /// With more than one split, at most kMaxAttentionSplit, each split takes a share of the keys. It writes each row's
  /// sums of values, largest score and sum of weights to partial [d_head + 2, n_row, n_head_kv * n_batch, n_split];
  /// `finish_attention` computes y from them. Null: the splits of the same rows, at most kMaxCluster, are a cluster,
  /// which combines them itself; only on Hopper, in a shape with such a kernel.
  float* partial;
  float scale;
  int n_segment, n_query, n_head, n_head_kv, n_batch, d_head, n_split;
  bool is_bf16;  // whether y is bf16, else float32

  /// Query heads per key head. Their queries are rows of the same product.
  VLA_HOST_DEVICE int group() const { return n_head / n_head_kv; }
  VLA_HOST_DEVICE int n_row() const { return group() * n_query; }
};

constexpr int kMaxHead = 256;
constexpr int kMaxAttentionSplit = 32;

/// The block of a kernel on tensor cores: `rows` rows of queries, 16 per warp, and `keys` keys per tile. With one key
/// group, a warp takes all keys of a tile while the next tile is copied. With more, meant for few rows, warps divide
/// the keys among them to compute scores, then the columns of the result.
struct AttentionShape {
  const char* kernel;
  int depth;  // the largest d_head
  int rows, key_groups, keys;
  const char* in_cluster = nullptr;  // the kernel for Hopper whose clusters combine shares of the keys, or null

  constexpr int n_thread() const { return rows / 16 * key_groups * 32; }
  /// Bytes of a row of queries, keys or values in shared memory, and of weights. They are padded by 16 bytes, so that
  /// the eight rows of a matrix load are in different banks.
  constexpr int row() const { return depth * 2 + 16; }
  constexpr int weight_row() const { return keys * 2 + 16; }
  /// Bytes of a row that a block leaves to its cluster, in the place of queries, keys and values: sums of values,
  /// largest score, sum of weights. The padding puts the four rows that half a warp writes in different banks.
  constexpr int sums_row() const { return depth * 4 + 32; }
  /// Whether a cluster can combine so many shares of the keys.
  constexpr bool fits_cluster(std::int64_t n_split) const {
    return in_cluster != nullptr && n_split > 1 && n_split <= kMaxCluster;
  }
  constexpr int stages() const { return key_groups == 1 ? 2 : 1; }
  constexpr int shared() const {
    const int exchanged = key_groups == 1 ? 0 : rows * (weight_row() + 4 * key_groups);
    return (rows + stages() * 2 * keys) * row() + exchanged;
  }
};
constexpr AttentionShape kAttentionShapes[] = {
    {"attention_bf16_64", 64, 64, 1, 64},
    {"attention_bf16_64_32", 64, 32, 4, 256, "hopper_attention_bf16_64_32"},
    {"attention_bf16_64_16", 64, 16, 8, 256, "hopper_attention_bf16_64_16"},
    {"attention_bf16_80", 80, 64, 1, 64},
    {"attention_bf16_128", 128, 64, 1, 64},
    {"attention_bf16_128_32", 128, 32, 4, 128, "hopper_attention_bf16_128_32"},
    {"attention_bf16_128_16", 128, 16, 8, 128, "hopper_attention_bf16_128_16"},
    {"attention_bf16_256", 256, 64, 2, 32},
    {"attention_bf16_256_32", 256, 32, 4, 64, "hopper_attention_bf16_256_32"},
};

/// On tensor cores: q, k and v are bf16; d_head, at most shape.depth, and all strides are multiples of 8. Weights are
/// rounded to bf16, sums and softmax are float32.
inline Launch attention_bf16(const AttentionShape& shape, const AttentionJob& job) {
  const unsigned cluster = cluster_of(job);
  return {cluster > 1 ? shape.in_cluster : shape.kernel,
          {blocks(job.n_row(), shape.rows), static_cast<unsigned>(job.n_head_kv * job.n_batch),
           static_cast<unsigned>(job.n_split)},
          static_cast<unsigned>(shape.n_thread()),
          static_cast<unsigned>(shape.shared()),
          cluster};
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
  const std::int64_t n_warp = static_cast<std::int64_t>(job.n_row()) * blocks(job.d_head, 64);
  return {"attention_finish", {blocks(n_warp, 4), static_cast<unsigned>(job.n_head_kv * job.n_batch)}, 128};
}

}  // namespace vla::cuda
