// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>

#include "kernels/rounded.h"
#include "kernels/row_kernel.h"

namespace vla::kernels {

/// Rows of d_head elements: the first one, and the strides between heads, tokens and batches.
struct HeadRows {
  const std::byte* data;
  std::int64_t first, head, token, batch;
  /// Layout of bf16 elements in rows of `d`; none: floats.
  RoundedLayout layout = RoundedLayout::none;
  std::int64_t d = 0;

  std::int64_t place(std::int64_t i_head, std::int64_t i_token, std::int64_t i_batch) const {
    return first + i_head * head + i_token * token + i_batch * batch;
  }
  const float* at(std::int64_t i_head, std::int64_t i_token, std::int64_t i_batch) const {
    return reinterpret_cast<const float*>(data) + place(i_head, i_token, i_batch);
  }
};

/// Keys and values in the layout that attention reads. A unit is one head of keys and values in one batch.
struct PackJob {
  std::int64_t d_head, n_head_kv, n_key, n_batch;
  HeadRows k, v;
  RowPrep prep;  // applied to keys
  std::byte* packed;

  std::int64_t n_unit() const { return n_head_kv * n_batch; }
};

/// Sizes and addresses of one attention.
struct AttentionJob {
  /// A segment of packed keys and values.
  struct Segment {
    const std::byte* packed;
    std::int64_t n_key;
    std::int64_t first = 0;  // keys in earlier segments
  };
  static constexpr int kMaxSegment = 6;

  std::int64_t d_head, n_head, n_head_kv, n_query, n_key, n_batch;
  float scale;
  HeadRows q;
  RowPrep prep;       // applied to queries
  const float* mask;  // [n_key, n_query], any values except +infinity, or null
  int n_segment;
  Segment segment[kMaxSegment];
  std::byte* out;  // floats [d_head, n_head, n_query, n_batch], or bf16 in out_layout
  RoundedLayout out_layout = RoundedLayout::none;
  std::int64_t block_rows;  // set by AttentionKernel::cut

  /// Query heads per key head. Their queries are rows of the same product.
  std::int64_t n_row() const { return n_head / n_head_kv * n_query; }
  std::int64_t n_unit() const { return n_head_kv * n_batch; }
};

/// Attention for one instruction set: softmax(q k * scale + mask) v in float32, heads concatenated, without a score
/// matrix in memory. It skips chunks of keys that are masked for a whole block of queries. Other arithmetics, such as
/// bf16 tiles, have kernels of their own.
struct AttentionKernel {
  /// Bytes of packed keys and values.
  std::size_t (*packed_size)(const PackJob& job);
  std::int64_t (*n_pack)(const PackJob& job);
  void (*pack)(const PackJob& job, std::int64_t item);
  /// Splits a job into items for that many threads. Returns the number of items.
  std::int64_t (*cut)(AttentionJob& job, int n_thread);
  void (*run)(const AttentionJob& job, std::int64_t item);
  /// The bf16 layout that `out` may have instead of float32 rows, if rows are a multiple of kTileSide long. Queries,
  /// keys and values without a prep may have it too.
  RoundedLayout rounded;
};

/// The widest head that has a kernel.
constexpr std::int64_t kMaxHead = 256;

}  // namespace vla::kernels
