// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "backend/graph.h"
#include "kernels/attention_kernel.h"

namespace vla::kernels {

/// Whether the graph's kernels have an attention for heads of this width.
bool has_attention(const Graph& g, std::int64_t d_head);

/// softmax(q k / sqrt(d_head) + mask) v in float32, heads concatenated, without a matrix of scores in memory.
/// q [d_head, n_head, n_query, n_batch], k and v [d_head, n_head_kv, n_key, n_batch], each with any strides but
/// contiguous in d_head; mask [n_key, n_query] of any numbers but +infinity, or none -> [d_head * n_head, n_query,
/// n_batch].
/// Chunks of keys that a block of queries sees nothing of (-infinity all over) are skipped.
/// `packed` is what pack_keys made of k and v, or none: then it is made here.
Tensor attention(Graph& g, Tensor q, Tensor k, Tensor v, Tensor mask, Tensor packed = {});

/// The same through a kernel of one's choice.
Tensor attention(Graph& g, const AttentionKernel& kernel, Tensor q, Tensor k, Tensor v, Tensor mask,
                 Tensor packed = {});

/// Keys and values as the graph's kernel reads them, whatever the queries: a vector of numbers.
Tensor pack_keys(Graph& g, Tensor k, Tensor v);

}  // namespace vla::kernels
