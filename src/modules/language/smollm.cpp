// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/language/smollm.h"

#include <fmt/format.h>

#include "nn/attention.h"
#include "nn/rope.h"
#include "nn/tokens.h"

namespace vla {
namespace {

void put(Graph& g, Cache& cache, const std::string& path, const KeyValue& kv) {
  cache.put(g, path + ".k", kv.key);
  cache.put(g, path + ".v", kv.value);
}

}  // namespace

Heads Heads::read(const Scope& s) {
  const Heads heads = {s.dim("n_head", 1024), s.dim("n_head_kv", 1024), s.dim("d_head"), s.number("rope_base")};
  s.require(heads.n_head % heads.n_head_kv == 0, "n_head_kv", fmt::format("a divisor of n_head {}", heads.n_head),
            std::to_string(heads.n_head_kv));
  s.require(heads.d_head % 2 == 0, "d_head", "an even number, for the rotary pairs", std::to_string(heads.d_head));
  s.require(heads.rope_base > 0, "rope_base", "a positive number", std::to_string(heads.rope_base));
  return heads;
}

KeyValueProjection::KeyValueProjection(const Scope& s, int d_model, const Heads& heads, float eps)
    : heads_(heads),
      norm_(s / "attn_norm", d_model, eps),
      k_(s / "attn_k", d_model, heads.d_key(), Bias::no),
      v_(s / "attn_v", d_model, heads.d_key(), Bias::no) {}

KeyValue KeyValueProjection::operator()(Graph& g, Tensor h, int first) const {
  const auto kv = Linear::group(g, {&k_, &v_}, h);
  const Tensor key = rope(g, split_heads(g, kv[0], heads_.n_head_kv), heads_.rope_base, first);
  return {key, split_heads(g, kv[1], heads_.n_head_kv)};
}

DecoderRest::DecoderRest(const Scope& s, int d_model, int d_ff, const Heads& heads, float eps)
    : heads_(heads),
      q_(s / "attn_q", d_model, heads.d_query(), Bias::no),
      out_(s / "attn_out", heads.d_query(), d_model, Bias::no),
      ffn_norm_(s / "ffn_norm", d_model, eps),
      mlp_(s, d_model, d_ff) {}

Tensor DecoderRest::operator()(Graph& g, Tensor x, Tensor h, int first, const KeyValue& seen, Tensor mask) const {
  const Tensor query = rope(g, split_heads(g, q_(g, h), heads_.n_head), heads_.rope_base, first);
  x = out_.added_to(g, x, attention(g, query, seen.key, seen.value, mask));
  return mlp_.added_to(g, x, ffn_norm_(g, x));
}

SmolLmBlock::SmolLmBlock(const Scope& s, int d_model, int d_ff, const Heads& heads, float eps)
    : Module(s), kv_(s, d_model, heads, eps), rest_(s, d_model, d_ff, heads, eps) {}

Tensor SmolLmBlock::forward(Graph& g, Tensor x, Tensor mask, Cache& cache) const {
  const Tensor h = kv_.norm(g, x);
  const KeyValue kv = kv_(g, h, 0);
  put(g, cache, path(), kv);
  return rest_(g, x, h, 0, kv, mask);
}

SmolLm::SmolLm(const Scope& s)
    : path_(s.path()),
      d_model_(s.dim("d_model")),
      heads_(Heads::read(s)),
      token_embd_(s / "token_embd", d_model_, s.dim("n_vocab", 1 << 24)) {
  const int n_layer = s.n_layer("n_layer"), d_ff = s.dim("d_ff");
  const float eps = s.number("norm_eps");
  for (int i = 0; i + 1 < n_layer; ++i) blocks_.emplace_back(s / "blk" / i, d_model_, d_ff, heads_, eps);
  last_.emplace(s / "blk" / (n_layer - 1), d_model_, heads_, eps);
}

std::string SmolLm::layer_path(int i_layer) const { return fmt::format("{}.blk.{}", path_, i_layer); }

void SmolLm::prefill(Graph& g, Tensor x, Tensor mask, Cache& cache) const {
  for (const SmolLmBlock& block : blocks_) x = block(g, x, mask, cache);
  put(g, cache, layer_path(n_layer() - 1), (*last_)(g, last_->norm(g, x), 0));
}

KeyValue SmolLm::cached(const Cache& cache, int i_layer) const {
  return {cache.get(layer_path(i_layer) + ".k"), cache.get(layer_path(i_layer) + ".v")};
}

}  // namespace vla
