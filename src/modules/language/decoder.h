// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <vector>

#include "modules/attention.h"
#include "nn/embedding.h"
#include "nn/mlp.h"

namespace vla {

/// The options in which decoder families differ.
struct DecoderFamily {
  Activation activation;  // activation of the gated MLP
  RotaryAngle rope_angle;
};
/// kSmolLm: a Llama with SmolVLA's own rotary angles. kGemma: Gemma as in transformers.
constexpr DecoderFamily kSmolLm = {Activation::silu, RotaryAngle::quotient};
constexpr DecoderFamily kGemma = {Activation::gelu_tanh, RotaryAngle::product};

/// One pre-norm layer of the language model; it puts its keys and values into the cache. Source: lerobot
/// policies/smolvla/smolvlm_with_expert.py forward, forward_attn_layer.
class DecoderBlock : public Module<DecoderBlock> {
 public:
  DecoderBlock(const Scope& s, int d_model, int d_ff, const Heads& heads, Activation activation, float eps);
  /// x [d_model, n], rotary [d_head, n], mask [n, n] or none -> the shape of x.
  Tensor forward(Graph& g, Tensor x, Tensor rotary, Tensor mask, Cache& cache) const;
  /// The same for one token [d_model, 1] after a cached prefix. Appends the token's keys and values to the cache;
  /// `mask` [n_prefix + capacity, 1] hides the positions after the token.
  Tensor next(Graph& g, Tensor x, Tensor rotary, Tensor mask, const AppendPlace& place, Cache& cache) const;

 private:
  Tensor rest(Graph& g, Tensor x, Tensor h, Tensor rotary, const std::vector<KeyValue>& segments, Tensor mask) const;

  RmsNorm attn_norm_;
  Attention attention_;
  RmsNorm ffn_norm_;
  GatedMlp mlp_;
};

/// The output that a policy reads from a language model: keys and values of a prefix, or the logits of the next token.
enum class DecoderOutput { keys_and_values, logits };

/// A language model of the Llama or Gemma family as a policy uses it: it embeds tokens and computes keys and values of
/// a prefix, layer by layer. If the policy reads no logits, the last layer ends with its keys and values, and `norm`
/// and `head` do not exist.
class Decoder {
 public:
  Decoder(const Scope& s, DecoderFamily family, DecoderOutput output = DecoderOutput::keys_and_values);

  /// tokens [n] i32 -> [d_model, n], not scaled.
  Tensor embed(Graph& g, Tensor tokens) const { return token_embd_(g, tokens); }
  /// x [d_model, n], mask [n, n] or none for full attention -> cache `<path>.blk.<i>.{k,v}`, each [d_head, n_head_kv,
  /// n], and, if the policy reads them, the `logits` [n_vocab] of the token after the last one.
  void prefill(Graph& g, Tensor x, Tensor mask, Cache& cache) const;

  /// Logits after token k ([1] i32) of at most `n_token` tokens after the prefix: x [d_model, 1] -> [n_vocab, 1]. Keys
  /// and values of the tokens before token k are in the cache.
  Tensor next(Graph& g, Tensor x, Tensor k, int n_token, Cache& cache) const;

  /// The cached keys and values of layer i.
  KeyValue cached(Graph& g, const Cache& cache, int i_layer) const;
  int d_model() const { return d_model_; }
  int n_layer() const { return static_cast<int>(blocks_.size()) + (last_kv_ ? 1 : 0); }
  const Heads& heads() const { return heads_; }

 private:
  std::string layer_path(int i_layer) const;
  Tensor logits(Graph& g, Tensor x) const;

  std::string path_;
  int d_model_;
  Heads heads_;
  Embedding token_embd_;
  std::vector<DecoderBlock> blocks_;
  std::optional<RmsNorm> last_norm_;
  std::optional<KeyValueProjection> last_kv_;
  std::optional<RmsNorm> norm_;
  std::optional<Linear> head_;
};

}  // namespace vla
