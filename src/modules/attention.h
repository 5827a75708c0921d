// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <span>
#include <string>

#include "graph/cache.h"
#include "nn/attention.h"
#include "nn/linear.h"
#include "nn/norm.h"
#include "nn/rope.h"

namespace vla {

/// The heads of an attention. Their total width may differ from the model's.
struct Heads {
  int n_head, n_head_kv, d_head;
  Bias bias = Bias::no;                // whether queries, keys and values have biases
  Bias out_bias = Bias::no;            // whether the output projection has a bias
  std::optional<float> norm_eps = {};  // RMS norm of queries and keys over each head
  Rule rule = Rule::floats;
  std::optional<float> sub_norm_eps = {};  // RMS norm over the concatenated heads, before the output projection
  float rope_base = 0;                     // 0: no rotary embedding by position
  RotaryAngle rope_angle = RotaryAngle::product;
  bool plain_keys = false;  // keys have no bias, even if `bias` is set

  int d_query() const { return n_head * d_head; }
  int d_key() const { return n_head_kv * d_head; }
  /// Reads n_head, n_head_kv, d_head and rope_base of `s` and checks that they fit together.
  static Heads read(const Scope& s, RotaryAngle angle);
  /// Heads that divide the model's width evenly, with all biases.
  static Heads even(int d_model, int n_head, Rule rule = Rule::floats) {
    return {.n_head = n_head,
            .n_head_kv = n_head,
            .d_head = d_model / n_head,
            .bias = Bias::yes,
            .out_bias = Bias::yes,
            .rule = rule};
  }
  /// The rotary table of `count` tokens starting at position `first`.
  Tensor rotary(Graph& g, int first, int count) const;
};

/// Write keys and values to the cache as `<path>.k` and `<path>.v`, and read them.
void put(Graph& g, Cache& cache, const std::string& path, const KeyValue& kv);
KeyValue get(Graph& g, const Cache& cache, const std::string& path);

/// The projections to keys and values: `attn_k` and `attn_v`, and `attn_k_norm` if heads are normalized.
class KeyValueProjection {
 public:
  KeyValueProjection(const Scope& s, int d_context, const Heads& heads);
  /// Keys and values of a context [d_context, n, ...]; keys are rotated by `rotary` [d_head, n] if given.
  KeyValue operator()(Graph& g, Tensor context, Tensor rotary = {}) const {
    return (*this)(g, context, context, rotary);
  }
  /// The same with separate contexts for keys and values.
  KeyValue operator()(Graph& g, Tensor key_context, Tensor value_context, Tensor rotary) const;

 private:
  int n_head_;
  Linear k_, v_;
  std::optional<RmsNorm> norm_;
};

/// Attention of tokens [d_model, n, ...] to a context [d_context, n_key, ...] or to themselves, with the projections
/// `attn_q`, `attn_k` and `attn_v`; `attn_out` projects the concatenated heads (tap `attn_heads`). `attn_q_norm`,
/// `attn_k_norm` and `attn_sub_norm` exist if `heads` enables these norms.
class Attention {
 public:
  Attention(const Scope& s, int d_model, int d_context, const Heads& heads);

  const KeyValueProjection& project() const { return kv_; }
  /// Attention of x to these segments: the shape of x. `rotary` [d_head, n] rotates queries; mask [n_key, n] or none.
  Tensor operator()(Graph& g, Tensor x, Tensor rotary, const std::vector<KeyValue>& segments, Tensor mask = {}) const;
  /// Self-attention; mask [n, n] or none.
  Tensor among(Graph& g, Tensor x, Tensor rotary, Tensor mask = {}) const {
    return (*this)(g, x, rotary, {kv_(g, x, rotary)}, mask);
  }

  const Heads& heads() const { return heads_; }

 private:
  Heads heads_;
  std::string heads_path_;
  Linear q_;
  std::optional<RmsNorm> norm_;
  KeyValueProjection kv_;
  std::optional<RmsNorm> sub_norm_;
  Linear out_;
};

}  // namespace vla
