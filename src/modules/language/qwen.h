// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <optional>
#include <span>
#include <vector>

#include "modules/language/decoder.h"
#include "modules/language/view_places.h"

namespace vla {

/// The options in which the model generations differ, and where features are read.
struct QwenFamily {
  Bias bias;                                 // biases of queries, keys and values
  bool head_norms;                           // norms of queries and keys over each head
  bool final_norm;                           // features are read after the final norm, else after the last layer
  Activation activation = Activation::silu;  // activation of the gated MLP
  Rule rule = Rule::floats;
  bool sub_norms = false;  // RMS norm before both output projections
};
constexpr QwenFamily kLlama2 = {Bias::no, false, true};
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
  /// The same without attention: every token passes the MLP only.
  Tensor alone(Graph& g, Tensor x) const;

 private:
  RmsNorm attn_norm_;
  Attention attention_;
  RmsNorm ffn_norm_;
  GatedMlp mlp_;
};

/// Qwen as a policy uses it: it embeds tokens and computes features of a sequence. Sources: transformers
/// modeling_qwen2.py Qwen2Model, modeling_qwen3.py Qwen3Model, modeling_qwen3_vl.py Qwen3VLTextModel.
class Qwen {
 public:
  Qwen(const Scope& s, QwenFamily family);

  /// tokens [n] i32 -> [d_model, n]. A prompt is embedded in pieces, which have no taps.
  Tensor embed(Graph& g, Tensor tokens) const { return token_embd_.forward(g, tokens); }
  /// The same with views [d_model, n_view_token, n_view] inserted at their places; the ids at these places are ignored.
  Tensor embed(Graph& g, Tensor tokens, Tensor views, const ViewPlaces& places) const;
  /// x [d_model, n] at positions 0 to n - 1, causal -> features [d_model, n].
  Tensor operator()(Graph& g, Tensor x) const;
  /// The same, layer by layer: calls `each` with a layer's index, from 0, and the layer's output. The last output has
  /// passed the final norm, if there is one. Source: transformers modeling_qwen2.py Qwen2Model.forward
  /// (all_hidden_states).
  void layers(Graph& g, Tensor x, const std::function<void(int, Tensor)>& each) const;
  /// The same for given positions and mask [n, n].
  Tensor operator()(Graph& g, Tensor x, std::span<const int> positions, Tensor mask) const;
  /// The same with full attention.
  Tensor bidirectional(Graph& g, Tensor x) const;
  /// The same, rotated by a table [d_head, n]; `added[i]` [d_model, n] is added to the result of layer i.
  Tensor operator()(Graph& g, Tensor x, Tensor rotary, Tensor mask, const std::vector<Tensor>& added) const;
  /// Features of tokens without attention in any layer: [d_model, n] -> the same shape.
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
