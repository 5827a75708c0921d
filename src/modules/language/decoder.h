// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <vector>

#include "modules/attention.h"
#include "nn/embedding.h"
#include "nn/mlp.h"

namespace vla {

/// What differs between families of decoders, as their references compute it.
struct DecoderFamily {
  Activation activation;  // activation of the gated MLP
  RotaryAngle rope_angle;
};
/// SmolVLA's own rotation on a Llama; Gemma as in transformers.
constexpr DecoderFamily kSmolLm = {Activation::silu, RotaryAngle::quotient};
constexpr DecoderFamily kGemma = {Activation::gelu_tanh, RotaryAngle::product};

/// One pre-norm layer of the language model; it puts its keys and values into the cache. Source: lerobot
/// policies/smolvla/smolvlm_with_expert.py forward, forward_attn_layer.
class DecoderBlock : public Module<DecoderBlock> {
 public:
  DecoderBlock(const Scope& s, int d_model, int d_ff, const Heads& heads, Activation activation, float eps);
  /// x [d_model, n], rotary [d_head, n], mask [n, n] or none -> the shape of x.
  Tensor forward(Graph& g, Tensor x, Tensor rotary, Tensor mask, Cache& cache) const;

 private:
  RmsNorm attn_norm_;
  Attention attention_;
  RmsNorm ffn_norm_;
  GatedMlp mlp_;
};

/// A language model of the Llama or Gemma family as a policy uses it: it embeds tokens and computes keys and values of
/// a prefix, layer by layer. The last layer's output is not read, so that layer stops at its keys and values.
class Decoder {
 public:
  Decoder(const Scope& s, DecoderFamily family);

  /// tokens [n] i32 -> [d_model, n], not scaled.
  Tensor embed(Graph& g, Tensor tokens) const { return token_embd_(g, tokens); }
  /// x [d_model, n], mask [n, n] or none for full attention -> cache `<path>.blk.<i>.{k,v}`, each [d_head, n_head_kv,
  /// n].
  void prefill(Graph& g, Tensor x, Tensor mask, Cache& cache) const;

  /// The cached keys and values of layer i.
  KeyValue cached(Graph& g, const Cache& cache, int i_layer) const;
  int d_model() const { return d_model_; }
  int n_layer() const { return static_cast<int>(blocks_.size()) + 1; }
  const Heads& heads() const { return heads_; }

 private:
  std::string layer_path(int i_layer) const;

  std::string path_;
  int d_model_;
  Heads heads_;
  Embedding token_embd_;
  std::vector<DecoderBlock> blocks_;
  std::optional<RmsNorm> last_norm_;
  std::optional<KeyValueProjection> last_kv_;
};

}  // namespace vla
