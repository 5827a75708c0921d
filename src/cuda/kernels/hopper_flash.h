// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/kernels/attention.h"
#include "cuda/kernels/tensor_map.h"

/// Attention of many query rows on Hopper, by wgmma, over one segment of keys: TMA fetches tiles of keys and values,
/// and the softmax of a tile overlaps with products of the tiles beside it. Results are those of attention_bf16, but
/// for the order of sums.
namespace vla::cuda {

struct FlashJob {
  TensorMap k, v;  // of the segment, see mapped_heads
  AttentionJob attention;
};

/// A block has `rows` rows of queries, 64 for each warpgroup that multiplies, and `keys` keys per tile, as many as its
/// registers hold. One more warp fetches tiles. Nine warps have 168 registers each, for a quarter of an SM has three.
struct FlashShape {
  const char* kernel;
  int depth, rows, keys;  // depth: the largest d_head
  bool takes_mask = true;

  /// Whether registers and shared memory of an SM hold two blocks.
  constexpr bool shares_sm() const { return rows == 64 && depth < 256; }
  constexpr int n_thread() const { return rows * 2 + 32; }
  /// Columns of the depth in a swizzled row: as many as divide the depth.
  constexpr int columns() const { return depth % 64 == 0 ? 64 : 16; }
  constexpr int tile() const { return keys * depth * 2; }
  /// Tiles of keys or values in shared memory, each with two mbarriers.
  static constexpr int kStages = 4, kBarriers = 16;
  constexpr int shared() const { return rows * depth * 2 + kStages * (tile() + kBarriers); }
};
constexpr FlashShape kFlashShapes[] = {
    {"hopper_flash_64x64", 64, 64, 128},        {"hopper_flash_64x128", 64, 128, 128},
    {"hopper_flash_80x64", 80, 64, 128, false}, {"hopper_flash_80x128", 80, 128, 128, false},
    {"hopper_flash_128x64", 128, 64, 80},       {"hopper_flash_128x128", 128, 128, 80},
    {"hopper_flash_256x64", 256, 64, 64},
};

/// Strides of a dimension of one element may be anything in `rows`.
inline MappedHeads mapped_heads(const FlashShape& shape, const AttentionJob& job, const HeadRows& rows) {
  const int n_key = job.segment[0].n_key;
  return {.data = rows.data,
          .d_head = job.d_head,
          .n_head = job.n_head_kv,
          .n_token = n_key,
          .n_batch = job.n_batch,
          .head = job.n_head_kv == 1 ? rows.token : rows.head,
          .token = rows.token,
          .batch = job.n_batch == 1 ? rows.token * n_key : rows.batch,
          .box_columns = shape.columns(),
          .box_tokens = shape.keys};
}

inline Launch hopper_flash(const FlashShape& shape, const AttentionJob& job) {
  return {shape.kernel,
          {blocks(job.n_row(), shape.rows), static_cast<unsigned>(job.n_head_kv * job.n_batch),
           static_cast<unsigned>(job.n_split)},
          static_cast<unsigned>(shape.n_thread()),
          static_cast<unsigned>(shape.shared())};
}

}  // namespace vla::cuda
