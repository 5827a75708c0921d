// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "modules/attention.h"
#include "nn/mlp.h"

namespace vla {

/// Options of a plain transformer layer of attention and MLP, as in DETR and BERT.
struct DetrFamily {
  int d_model, n_head, d_ff;
  Activation activation;
  bool pre_norm;  // norms before attention and MLP (pre-norm), else after the residual sum (post-norm)
  float norm_eps;

  /// Reads d_model, n_head, d_ff, activation, norm and norm_eps of `s`.
  static DetrFamily read(const Scope& s);
};

/// A residual branch with its norm: x + branch(norm(x)), or norm(x + branch(x)).
class NormedSum {
 public:
  NormedSum(const Scope& s, const DetrFamily& family)
      : norm_(s, family.d_model, family.norm_eps), pre_norm_(family.pre_norm) {}
  template <class Branch>
  Tensor operator()(Graph& g, Tensor x, const Branch& branch) const {
    if (pre_norm_) return add(g, x, branch(norm_(g, x)));
    return norm_(g, add(g, x, branch(x)));
  }

 private:
  LayerNorm norm_;
  bool pre_norm_;
};

/// Self-attention in which positions are added to the inputs of queries and keys, but not of values. All positions in
/// this file may be none.
class PlacedAttention {
 public:
  PlacedAttention(const Scope& s, const DetrFamily& family)
      : norm_(s / "attn_norm", family), attention_(s, family.d_model, family.d_model, heads(family)) {}
  /// x, position [d_model, n], mask [n, n] or none -> [d_model, n].
  Tensor operator()(Graph& g, Tensor x, Tensor position, Tensor mask = {}) const;
  static Heads heads(const DetrFamily& family) { return Heads::even(family.d_model, family.n_head); }

 private:
  NormedSum norm_;
  Attention attention_;
};

/// Self-attention and an MLP. x, position [d_model, n], mask [n, n] or none -> [d_model, n].
/// Sources: lerobot policies/act/modeling_act.py ACTEncoderLayer; transformers modeling_bert.py BertLayer; TurboVLA
/// turbovla/models/components/transformer.py TransformerEncoderLayer.
class DetrEncoderLayer : public Module<DetrEncoderLayer> {
 public:
  DetrEncoderLayer(const Scope& s, const DetrFamily& family);
  Tensor forward(Graph& g, Tensor x, Tensor position, Tensor mask = {}) const;

 private:
  PlacedAttention among_;
  NormedSum ffn_norm_;
  Mlp mlp_;
};

/// Self-attention of queries, attention to the encoder's tokens (`cross`), and an MLP.
/// Sources: lerobot policies/act/modeling_act.py ACTDecoderLayer; lerobot_policy_turbovla action_decoder.py
/// TurboVLADecoderLayer; torch.nn.TransformerDecoderLayer.
class DetrDecoderLayer : public Module<DetrDecoderLayer> {
 public:
  DetrDecoderLayer(const Scope& s, const DetrFamily& family);
  /// Keys and values of the encoder's tokens: tokens, position [d_model, n].
  KeyValue project(Graph& g, Tensor tokens, Tensor position) const;
  /// The first part of the layer, self-attention of the queries: x, position [d_model, n_query] -> [d_model, n_query].
  Tensor among(Graph& g, Tensor x, Tensor position) const { return among_(g, x, position); }
  /// The rest of the layer, for the x that `among` returned.
  Tensor forward(Graph& g, Tensor x, Tensor position, const KeyValue& seen) const;

 private:
  PlacedAttention among_;
  NormedSum cross_norm_;
  Attention cross_;
  NormedSum ffn_norm_;
  Mlp mlp_;
};

/// Decoder layers over queries that do not depend on the observation. Each part is computed at its own rate.
class DetrDecoder {
 public:
  DetrDecoder() = default;
  DetrDecoder(const Scope& s, const DetrFamily& family, int n_layer);
  /// Load rate: the queries' self-attention in the first layer. queries, position [d_model, n_query].
  void constants(Graph& g, Tensor queries, Tensor position, Cache& cache) const;
  /// Observation rate: keys and values of the encoder's tokens in every layer. tokens, position [d_model, n].
  void prefix(Graph& g, Tensor tokens, Tensor position, Cache& cache) const;
  /// The queries after all layers: position [d_model, n_query] or none -> [d_model, n_query].
  Tensor operator()(Graph& g, Tensor position, const Cache& cache) const;

 private:
  std::vector<DetrDecoderLayer> layers_;
};

}  // namespace vla
