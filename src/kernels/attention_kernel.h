// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "kernels/turns.h"

namespace vla::kernels {

/// One attention: sizes, and where everything lies.
struct AttentionJob {
  /// Rows of d_head floats, and how many floats lie from one head, token or batch to the next.
  struct Rows {
    const float* data;
    std::int64_t head, token, batch;
    const float* at(std::int64_t i_head, std::int64_t i_token, std::int64_t i_batch) const {
      return data + i_head * head + i_token * token + i_batch * batch;
    }
  };

  std::int64_t d_head, n_head, n_head_kv, n_query, n_key, n_batch;
  float scale;
  Rows q, k, v;
  const float* mask;  // [n_key, n_query], or null
  float* packed;      // what `pack` writes and `run` reads
  float* out;         // [d_head, n_head, n_query, n_batch]
  Turns* turns;       // of `run`

  /// Query heads that share keys and values: their queries are rows of one and the same product.
  std::int64_t n_row() const { return n_head / n_head_kv * n_query; }
  std::int64_t n_unit() const { return n_head_kv * n_batch; }
};

/// Attention for one instruction set, in two operations with a barrier between them. Another arithmetic (bf16 tiles)
/// is another such pair.
struct AttentionKernel {
  /// Floats that one job's packed keys and values take.
  std::int64_t (*packed_size)(const AttentionJob& job);
  /// Lays keys and values out as `run` reads them; thread `ith` of `nth` does its part.
  void (*pack)(const AttentionJob& job, int ith, int nth);
  void (*run)(const AttentionJob& job, int ith, int nth);
};

/// Heads wider than this have no kernel.
constexpr std::int64_t kMaxHead = 256;

}  // namespace vla::kernels
