// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <vector>

#include "graph/graph.h"

namespace vla {

/// Keys and values of one segment of tokens: [d_head, n_head_kv, n_key, n_batch] each.
struct KeyValue {
  Tensor key, value;
};

/// softmax(q k / sqrt(d_head) + mask) v in float32, heads concatenated, over the keys and values of all segments in
/// order. q [d_head, n_head, n_query, n_batch], mask [n_key, n_query] or none -> [d_head * n_head, n_query, n_batch].
/// Query head h reads key head h / (n_head / n_head_kv). The mask is 0 for a visible key, -infinity for a hidden one,
/// and ln(n) for a key that stands for n equal keys with equal values. Every query must see at least one key. Source:
/// lerobot policies/smolvla/smolvlm_with_expert.py eager_attention_forward.
Tensor attention(Graph& g, Tensor q, const std::vector<KeyValue>& segments, Tensor mask);

/// The mask of consecutive groups of tokens: a token sees its own group and every earlier one. Sizes in tokens; the
/// mask is [n, n] with n their sum. Source: lerobot policies/common/vla_utils.py make_att_2d_masks.
Tensor group_mask(Graph& g, std::span<const int> group_sizes);

/// The mask in which tokens attend to their own group only: [n, n]. Groups are consecutive.
Tensor apart_mask(Graph& g, std::span<const int> group_sizes);

/// The mask of `n_query` tokens that see the first `n_seen` of `n_key`: [n_key, n_query].
Tensor first_mask(Graph& g, int n_seen, int n_key, int n_query);

/// The mask of `n_query` tokens, each of which sees `n_past` earlier tokens, the queries before it, and itself: [n_past
/// + n_query, n_query].
Tensor causal_mask(Graph& g, int n_past, int n_query);

/// The causal mask of a sequence in which every token j with `seen[j]` false is hidden from all tokens: [n, n]. The
/// first token must be visible.
Tensor causal_mask(Graph& g, const std::vector<bool>& seen);
/// The mask in which key j stands for `copies[j]` equal keys: it adds ln(copies[j]), because exp(score + ln n) is n
/// times exp(score). [copies.size(), n_query], or none if all are 1.
Tensor copies_mask(Graph& g, const std::vector<int>& copies, int n_query);

/// tanh of numbers within ±1e9, [d, n] -> the same shape. It is an attention over the values 1 and -1 with the scores x
/// and -x, which gives (e^x - e^-x) / (e^x + e^-x). Source: torch tanh.
Tensor tanh_of(Graph& g, Tensor x);

/// [d_model, n, ...] -> [d_model / n_head, n_head, n, ...].
Tensor split_heads(Graph& g, Tensor x, int n_head);
/// [d_head, n_head, n, ...] -> [d_head * n_head, n, ...].
Tensor merge_heads(Graph& g, Tensor x);

}  // namespace vla
