// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <vector>

#include "modules/language/decoder.h"

namespace vla {

/// One layer of Qwen2: attention whose queries, keys and values have biases, then a gated MLP.
/// Source: transformers modeling_qwen2.py Qwen2DecoderLayer.
class QwenBlock : public Module<QwenBlock> {
 public:
  QwenBlock(const Scope& s, int d_model, int d_ff, const Heads& heads, float eps);
  /// x [d_model, n] of tokens at `positions`, mask [n, n] -> the shape of x.
  Tensor forward(Graph& g, Tensor x, std::span<const int> positions, Tensor mask) const;
  /// The same where attention adds nothing: a token for itself.
  Tensor alone(Graph& g, Tensor x) const;

 private:
  Heads heads_;
  RmsNorm attn_norm_;
  Linear q_, k_, v_, out_;
  RmsNorm ffn_norm_;
  GatedMlp mlp_;
};

/// Qwen2 as a policy uses it: it embeds tokens and turns a sequence into features, read after the final norm.
/// Source: transformers modeling_qwen2.py Qwen2Model.
class Qwen {
 public:
  explicit Qwen(const Scope& s);

  /// tokens [n] i32 -> [d_model, n]. A prompt is embedded piece by piece, so the pieces are no taps.
  Tensor embed(Graph& g, Tensor tokens) const { return token_embd_.forward(g, tokens); }
  /// x [d_model, n] of tokens at `positions`, mask [n, n] -> features [d_model, n].
  Tensor operator()(Graph& g, Tensor x, std::span<const int> positions, Tensor mask) const;
  /// Features of tokens whose attention is cut out of every layer: [d_model, n] -> the same shape.
  Tensor alone(Graph& g, Tensor x) const;

  int d_model() const { return d_model_; }

 private:
  int d_model_;
  Heads heads_;
  Embedding token_embd_;
  std::vector<QwenBlock> blocks_;
  RmsNorm norm_;
};

}  // namespace vla
