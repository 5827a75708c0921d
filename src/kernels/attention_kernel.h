// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>

#include "kernels/rounded.h"
#include "kernels/row_kernel.h"

namespace vla::kernels {

/// Rows of d_head elements: which one is the first, and how many from one head, token or batch to the next.
struct HeadRows {
  const std::byte* data;
  std::int64_t first, head, token, batch;
  /// The layout of bf16 elements, in rows of `d`; none: floats.
  RoundedLayout layout = RoundedLayout::none;
  std::int64_t d = 0;

  std::int64_t place(std::int64_t i_head, std::int64_t i_token, std::int64_t i_batch) const {
    return first + i_head * head + i_token * token + i_batch * batch;
  }
  const float* at(std::int64_t i_head, std::int64_t i_token, std::int64_t i_batch) const {
    return reinterpret_cast<const float*>(data) + place(i_head, i_token, i_batch);
  }
};

/// Keys and values that are laid out as attention reads them. A unit is one head of keys and values, of one batch.
struct PackJob {
  std::int64_t d_head, n_head_kv, n_key, n_batch;
  HeadRows k, v;
  RowPrep prep;  // of keys
  std::byte* packed;

  std::int64_t n_unit() const { return n_head_kv * n_batch; }
};

/// One attention: sizes and addresses.
struct AttentionJob {
  /// Packed keys and values that stand one after the other.
  struct Segment {
    const std::byte* packed;
    std::int64_t n_key;
    std::int64_t first = 0;  // keys of the segments before it
  };
  static constexpr int kMaxSegment = 6;

  std::int64_t d_head, n_head, n_head_kv, n_query, n_key, n_batch;
  float scale;
  HeadRows q;
  RowPrep prep;       // of queries
  const float* mask;  // [n_key, n_query] of any values but +infinity, or null
  int n_segment;
  Segment segment[kMaxSegment];
  std::byte* out;  // floats [d_head, n_head, n_query, n_batch], or bf16 in out_layout
  RoundedLayout out_layout = RoundedLayout::none;
  std::int64_t block_rows;  // made by AttentionKernel::cut

  /// Query heads that share keys and values: their queries are rows of one and the same product.
  std::int64_t n_row() const { return n_head / n_head_kv * n_query; }
  std::int64_t n_unit() const { return n_head_kv * n_batch; }
};

/// Attention for one instruction set: softmax(q k * scale + mask) v in float32, heads concatenated, without a matrix of
/// scores in memory. Chunks of keys that a block of queries sees nothing of (-infinity all over) are skipped. Another
/// arithmetic (bf16 tiles) is another row.
struct AttentionKernel {
  /// Bytes that packed keys and values take.
  std::size_t (*packed_size)(const PackJob& job);
  std::int64_t (*n_pack)(const PackJob& job);
  void (*pack)(const PackJob& job, std::int64_t item);
  /// Cuts a job into items for so many threads, and says how many there are.
  std::int64_t (*cut)(AttentionJob& job, int n_thread);
  void (*run)(const AttentionJob& job, std::int64_t item);
  /// How `out` may lie instead of float32 rows, its rows a multiple of kTileSide long; and queries, keys and values to
  /// which nothing is done first.
  RoundedLayout rounded;
};

/// Heads wider than this have no kernel.
constexpr std::int64_t kMaxHead = 256;

}  // namespace vla::kernels
