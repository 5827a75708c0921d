// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <vector>

#include "backend/cache.h"
#include "nn/embedding.h"
#include "nn/linear.h"
#include "nn/mlp.h"
#include "nn/norm.h"
#include "nn/rope.h"

namespace vla {

/// The heads of an attention whose width need not be the model's.
struct Heads {
  int n_head, n_head_kv, d_head;
  float rope_base;
  RotaryAngle rope_angle;

  int d_query() const { return n_head * d_head; }
  int d_key() const { return n_head_kv * d_head; }
  /// Reads n_head, n_head_kv, d_head and rope_base of `s`, and checks that they go together.
  static Heads read(const Scope& s, RotaryAngle angle);
  /// [d_head, n_head, n_token] -> the same shape, turned; token 0 stands at position `first`.
  Tensor turn(Graph& g, Tensor x, int first) const { return rope(g, x, rope_base, rope_angle, first); }
};

/// What a layer attends to. Both [d_head, n_head_kv, n_token], keys after the rotary embedding.
struct KeyValue {
  Tensor key, value;
  Tensor packed = {};  // both as kernels read them, or none

  /// Into the cache, as `<path>.k` and `<path>.v`.
  void put(Graph& g, Cache& cache, const std::string& path) const;
  /// The same where steps read them as they are, with nothing appended: laid out for that as well.
  void put_packed(Graph& g, Cache& cache, const std::string& path) const;
  static KeyValue get(const Cache& cache, const std::string& path);
};

/// What tells the families of decoders apart, as their references compute them.
struct DecoderFamily {
  Activation activation;  // of the gated MLP
  RotaryAngle rope_angle;
};
/// SmolVLA's own rotation beside a Llama; Gemma as transformers has it.
constexpr DecoderFamily kSmolLm = {Activation::silu, RotaryAngle::quotient};
constexpr DecoderFamily kGemma = {Activation::gelu_tanh, RotaryAngle::product};

/// The key and value products of a layer.
class KeyValueProjection {
 public:
  KeyValueProjection(const Scope& s, int d_model, const Heads& heads);
  /// `h` [d_model, n_token], already normalized; token 0 stands at position `first`.
  KeyValue operator()(Graph& g, Tensor h, int first) const;

 private:
  Heads heads_;
  Linear k_, v_;
};

/// Queries, attention to given keys and values, output product.
class QueryAttention {
 public:
  QueryAttention(const Scope& s, int d_model, const Heads& heads);
  /// `h` [d_model, n_token], already normalized; token 0 stands at position `first`. -> the same shape.
  Tensor operator()(Graph& g, Tensor h, int first, const KeyValue& seen, Tensor mask) const;
  /// residual + the same.
  Tensor added_to(Graph& g, Tensor residual, Tensor h, int first, const KeyValue& seen, Tensor mask) const;

 private:
  Tensor mix(Graph& g, Tensor h, int first, const KeyValue& seen, Tensor mask) const;

  Heads heads_;
  Linear q_, out_;
};

/// A pre-norm decoder layer after its keys and values: attention, residual, gated MLP, residual.
/// Source: lerobot policies/smolvla/smolvlm_with_expert.py forward, forward_attn_layer.
class DecoderRest {
 public:
  DecoderRest(const Scope& s, int d_model, int d_ff, const Heads& heads, Activation activation, float eps);
  /// `h` is the normalized x; its token 0 stands at position `first`. x [d_model, n_token] -> the same shape.
  Tensor operator()(Graph& g, Tensor x, Tensor h, int first, const KeyValue& seen, Tensor mask) const;

 private:
  QueryAttention attention_;
  RmsNorm ffn_norm_;
  GatedMlp mlp_;
};

/// One layer of the language model; it leaves its keys and values in the cache.
class DecoderBlock : public Module<DecoderBlock> {
 public:
  DecoderBlock(const Scope& s, int d_model, int d_ff, const Heads& heads, Activation activation, float eps);
  Tensor forward(Graph& g, Tensor x, Tensor mask, Cache& cache) const;

 private:
  RmsNorm attn_norm_;
  KeyValueProjection kv_;
  DecoderRest rest_;
};

/// A language model of the Llama or Gemma family as a policy uses it: it embeds tokens and turns a prefix into keys and
/// values, layer by layer. Nothing reads the last layer's output, so that layer stops at its keys and values.
class Decoder {
 public:
  Decoder(const Scope& s, DecoderFamily family);

  /// tokens [n] i32 -> [d_model, n], not scaled.
  Tensor embed(Graph& g, Tensor tokens) const { return token_embd_(g, tokens); }
  /// x [d_model, n], mask [n, n] or none where all see all -> cache `<path>.blk.<i>.{k,v}`, each [d_head, n_head_kv,
  /// n].
  void prefill(Graph& g, Tensor x, Tensor mask, Cache& cache) const;

  /// The cached keys and values of layer i.
  KeyValue cached(const Cache& cache, int i_layer) const;
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
