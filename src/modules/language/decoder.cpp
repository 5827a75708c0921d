// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/language/decoder.h"

#include <fmt/format.h>

#include "nn/attention.h"
#include "nn/tokens.h"

namespace vla {

void KeyValue::put(Graph& g, Cache& cache, const std::string& path) const {
  cache.put(g, path + ".k", key);
  cache.put(g, path + ".v", value);
}

void KeyValue::put_packed(Graph& g, Cache& cache, const std::string& path) const {
  put(g, cache, path);
  if (const Tensor numbers = pack_keys(g, key, value)) cache.put(g, path + ".packed", numbers);
}

KeyValue KeyValue::get(const Cache& cache, const std::string& path) {
  const std::string packed = path + ".packed";
  return {cache.get(path + ".k"), cache.get(path + ".v"), cache.has(packed) ? cache.get(packed) : Tensor()};
}

Heads Heads::read(const Scope& s, RotaryAngle angle) {
  const Heads heads = {s.dim("n_head", 1024), s.dim("n_head_kv", 1024), s.dim("d_head"),
                       s.number("rope_base", kRopeBase), angle};
  s.require(heads.n_head % heads.n_head_kv == 0, "n_head_kv", fmt::format("a divisor of n_head {}", heads.n_head),
            std::to_string(heads.n_head_kv));
  s.require(heads.d_head % 2 == 0, "d_head", "an even number, for the rotary pairs", std::to_string(heads.d_head));
  return heads;
}

KeyValueProjection::KeyValueProjection(const Scope& s, int d_model, const Heads& heads)
    : heads_(heads),
      k_(s / "attn_k", d_model, heads.d_key(), Bias::no),
      v_(s / "attn_v", d_model, heads.d_key(), Bias::no) {}

KeyValue KeyValueProjection::operator()(Graph& g, Tensor h, int first) const {
  const auto kv = Linear::group(g, {&k_, &v_}, h);
  return {heads_.turn(g, split_heads(g, kv[0], heads_.n_head_kv), first), split_heads(g, kv[1], heads_.n_head_kv)};
}

QueryAttention::QueryAttention(const Scope& s, int d_model, const Heads& heads)
    : heads_(heads),
      q_(s / "attn_q", d_model, heads.d_query(), Bias::no),
      out_(s / "attn_out", heads.d_query(), d_model, Bias::no) {}

Tensor QueryAttention::mix(Graph& g, Tensor h, int first, const KeyValue& seen, Tensor mask) const {
  const Tensor query = heads_.turn(g, split_heads(g, q_(g, h), heads_.n_head), first);
  return attention(g, query, seen.key, seen.value, mask, seen.packed);
}

Tensor QueryAttention::operator()(Graph& g, Tensor h, int first, const KeyValue& seen, Tensor mask) const {
  return out_(g, mix(g, h, first, seen, mask));
}

Tensor QueryAttention::added_to(Graph& g, Tensor residual, Tensor h, int first, const KeyValue& seen,
                                Tensor mask) const {
  return out_.added_to(g, residual, mix(g, h, first, seen, mask));
}

DecoderRest::DecoderRest(const Scope& s, int d_model, int d_ff, const Heads& heads, Activation activation, float eps)
    : attention_(s, d_model, heads), ffn_norm_(s / "ffn_norm", d_model, eps), mlp_(s, d_model, d_ff, activation) {}

Tensor DecoderRest::operator()(Graph& g, Tensor x, Tensor h, int first, const KeyValue& seen, Tensor mask) const {
  x = attention_.added_to(g, x, h, first, seen, mask);
  return mlp_.added_to(g, x, ffn_norm_(g, x));
}

DecoderBlock::DecoderBlock(const Scope& s, int d_model, int d_ff, const Heads& heads, Activation activation, float eps)
    : Module(s),
      attn_norm_(s / "attn_norm", d_model, eps),
      kv_(s, d_model, heads),
      rest_(s, d_model, d_ff, heads, activation, eps) {}

Tensor DecoderBlock::forward(Graph& g, Tensor x, Tensor mask, Cache& cache) const {
  const Tensor h = attn_norm_(g, x);
  const KeyValue kv = kv_(g, h, 0);
  kv.put(g, cache, path());
  return rest_(g, x, h, 0, kv, mask);
}

Decoder::Decoder(const Scope& s, DecoderFamily family)
    : path_(s.path()),
      d_model_(s.dim("d_model")),
      heads_(Heads::read(s, family.rope_angle)),
      token_embd_(s / "token_embd", d_model_, s.dim("n_vocab", 1 << 24)) {
  const int n_layer = s.n_layer("n_layer"), d_ff = s.dim("d_ff");
  const float eps = s.number("norm_eps", kNormEps);
  for (int i = 0; i + 1 < n_layer; ++i)
    blocks_.emplace_back(s / "blk" / i, d_model_, d_ff, heads_, family.activation, eps);
  const Scope last = s / "blk" / (n_layer - 1);
  last_norm_.emplace(last / "attn_norm", d_model_, eps);
  last_kv_.emplace(last, d_model_, heads_);
}

std::string Decoder::layer_path(int i_layer) const { return fmt::format("{}.blk.{}", path_, i_layer); }

void Decoder::prefill(Graph& g, Tensor x, Tensor mask, Cache& cache) const {
  for (const DecoderBlock& block : blocks_) x = block(g, x, mask, cache);
  (*last_kv_)(g, (*last_norm_)(g, x), 0).put(g, cache, layer_path(n_layer() - 1));
}

KeyValue Decoder::cached(const Cache& cache, int i_layer) const { return KeyValue::get(cache, layer_path(i_layer)); }

}  // namespace vla
