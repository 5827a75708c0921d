// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <span>
#include <vector>

#include "modules/language/decoder.h"
#include "modules/language/view_places.h"

namespace vla {

/// How the generations differ, and where features are read.
struct QwenFamily {
  Bias bias;                                 // of queries, keys and values
  bool head_norms;                           // queries and keys are normalized head by head
  bool final_norm;                           // features are read behind it, else they are what the last layer gives
  Activation activation = Activation::silu;  // of the gated MLP
  Rule rule = Rule::floats;
  bool sub_norms = false;  // both output products have an RMS norm in front
};
constexpr QwenFamily kQwen2 = {Bias::yes, false, true};
constexpr QwenFamily kQwen3 = {Bias::no, true, true};
constexpr QwenFamily kQwen3Inner = {Bias::no, true, false};
/// BitNet b1.58. Source: BitVLA modeling_bitnet.py BitNetModel.
constexpr QwenFamily kBitNet = {Bias::no, false, true, Activation::relu_squared, Rule::int8_rows, true};

/// One layer: attention, then a gated MLP.
/// Sources: transformers modeling_qwen2.py Qwen2DecoderLayer, modeling_qwen3.py Qwen3DecoderLayer.
class QwenBlock : public Module<QwenBlock> {
 public:
  QwenBlock(const Scope& s, int d_model, int d_ff, const Heads& heads, float eps, Activation activation);
  /// x [d_model, n], rotary [d_head, n], mask [n, n] or none -> the shape of x. `added` [d_model, n], or none, is added
  /// to the layer's result.
  Tensor forward(Graph& g, Tensor x, Tensor rotary, Tensor mask, Tensor added = {}) const;
  /// The same where attention adds nothing: a token for itself.
  Tensor alone(Graph& g, Tensor x) const;

 private:
  RmsNorm attn_norm_;
  Attention attention_;
  RmsNorm ffn_norm_;
  GatedMlp mlp_;
};

/// Qwen as a policy uses it: it embeds tokens and turns a sequence into features.
/// Sources: transformers modeling_qwen2.py Qwen2Model, modeling_qwen3.py Qwen3Model, modeling_qwen3_vl.py
/// Qwen3VLTextModel.
class Qwen {
 public:
  Qwen(const Scope& s, QwenFamily family);

  /// tokens [n] i32 -> [d_model, n]. A prompt is embedded piece by piece, so the pieces are no taps.
  Tensor embed(Graph& g, Tensor tokens) const { return token_embd_.forward(g, tokens); }
  /// The same with views [d_model, n_view_token, n_view] at their places, whatever the ids there.
  Tensor embed(Graph& g, Tensor tokens, Tensor views, const ViewPlaces& places) const;
  /// x [d_model, n] of tokens at 0 to n - 1, each of which sees those before it -> features [d_model, n].
  Tensor operator()(Graph& g, Tensor x) const;
  /// The same for tokens at `positions`, mask [n, n].
  Tensor operator()(Graph& g, Tensor x, std::span<const int> positions, Tensor mask) const;
  /// The same where every token sees all.
  Tensor bidirectional(Graph& g, Tensor x) const;
  /// The same for tokens that turn by a table [d_head, n]; `added[i]` [d_model, n] is added to the result of layer i.
  Tensor operator()(Graph& g, Tensor x, Tensor rotary, Tensor mask, const std::vector<Tensor>& added) const;
  /// Features of tokens whose attention is cut out of every layer: [d_model, n] -> the same shape.
  Tensor alone(Graph& g, Tensor x) const;

  int d_model() const { return d_model_; }
  int n_layer() const { return static_cast<int>(blocks_.size()); }
  const Heads& heads() const { return heads_; }

 private:
  int d_model_;
  Heads heads_;
  Embedding token_embd_;
  std::vector<QwenBlock> blocks_;
  std::optional<RmsNorm> norm_;
};

}  // namespace vla
