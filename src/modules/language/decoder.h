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

namespace vla {

/// The heads of an attention whose width need not be the model's.
struct Heads {
  int n_head, n_head_kv, d_head;
  float rope_base;

  int d_query() const { return n_head * d_head; }
  int d_key() const { return n_head_kv * d_head; }
  /// Reads n_head, n_head_kv, d_head and rope_base of `s`, and checks that they go together.
  static Heads read(const Scope& s);
};

/// What a layer attends to. Both [d_head, n_head_kv, n_token], keys after the rotary embedding.
struct KeyValue {
  Tensor key, value;
};

/// The norm and the key and value products of a decoder layer: all that the last layer of a prefix needs.
class KeyValueProjection {
 public:
  KeyValueProjection(const Scope& s, int d_model, const Heads& heads, float eps);

  Tensor norm(Graph& g, Tensor x) const { return norm_(g, x); }
  /// `h` [d_model, n_token], already normalized; token 0 stands at position `first`.
  KeyValue operator()(Graph& g, Tensor h, int first) const;

 private:
  Heads heads_;
  RmsNorm norm_;
  Linear k_, v_;
};

/// A pre-norm decoder layer after its keys and values: queries, attention, output product, residual, gated MLP,
/// residual. Source: lerobot policies/smolvla/smolvlm_with_expert.py forward, forward_attn_layer.
class DecoderRest {
 public:
  DecoderRest(const Scope& s, int d_model, int d_ff, const Heads& heads, float eps);
  /// `h` is the normalized x; its token 0 stands at position `first`. x [d_model, n_token] -> the same shape.
  Tensor operator()(Graph& g, Tensor x, Tensor h, int first, const KeyValue& seen, Tensor mask) const;

 private:
  Heads heads_;
  Linear q_, out_;
  RmsNorm ffn_norm_;
  SiluGatedMlp mlp_;
};

/// One layer of the language model; it leaves its keys and values in the cache.
class DecoderBlock : public Module<DecoderBlock> {
 public:
  DecoderBlock(const Scope& s, int d_model, int d_ff, const Heads& heads, float eps);
  Tensor forward(Graph& g, Tensor x, Tensor mask, Cache& cache) const;

 private:
  KeyValueProjection kv_;
  DecoderRest rest_;
};

/// The language model as a policy uses it: it embeds tokens and turns a prefix into keys and values, layer by layer.
/// Nothing reads the last layer's output, so that layer stops at its keys and values.
class Decoder {
 public:
  explicit Decoder(const Scope& s);

  /// tokens [n] i32 -> [d_model, n], not scaled.
  Tensor embed(Graph& g, Tensor tokens) const { return token_embd_(g, tokens); }
  /// x [d_model, n], mask [n, n] -> cache `<path>.blk.<i>.{k,v}`, each [d_head, n_head_kv, n].
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
  std::optional<KeyValueProjection> last_;
};

}  // namespace vla
