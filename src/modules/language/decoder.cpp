// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/language/decoder.h"

#include <fmt/format.h>

#include "nn/tokens.h"

namespace vla {
namespace {

/// The identity matrix [n, n].
Tensor identity(Graph& g, int n) {
  return g.constant("identity", {n, n, 1, 1}, [n] {
    std::vector<float> values(static_cast<std::size_t>(n) * static_cast<std::size_t>(n));
    for (std::size_t i = 0; i < values.size(); i += static_cast<std::size_t>(n) + 1) values[i] = 1;
    return values;
  });
}

}  // namespace

DecoderBlock::DecoderBlock(const Scope& s, int d_model, int d_ff, const Heads& heads, Activation activation, float eps)
    : Module(s),
      attn_norm_(s / "attn_norm", d_model, eps),
      attention_(s, d_model, d_model, heads),
      ffn_norm_(s / "ffn_norm", d_model, eps),
      mlp_(s, d_model, d_ff, activation) {}

Tensor DecoderBlock::forward(Graph& g, Tensor x, Tensor rotary, Tensor mask, Cache& cache) const {
  const Tensor h = attn_norm_(g, x);
  const KeyValue kv = attention_.project()(g, h, rotary);
  put(g, cache, path(), kv);
  return rest(g, x, h, rotary, {kv}, mask);
}

Tensor DecoderBlock::next(Graph& g, Tensor x, Tensor rotary, Tensor mask, const AppendPlace& place,
                          Cache& cache) const {
  const Tensor h = attn_norm_(g, x);
  const KeyValue own = attention_.project()(g, h, rotary);
  const KeyValue answered = {cache.append(g, path() + ".next_k", own.key, place),
                             cache.append(g, path() + ".next_v", own.value, place)};
  return g.name(path(), rest(g, x, h, rotary, {get(g, cache, path()), answered}, mask));
}

Tensor DecoderBlock::rest(Graph& g, Tensor x, Tensor h, Tensor rotary, const std::vector<KeyValue>& segments,
                          Tensor mask) const {
  x = add(g, x, attention_(g, h, rotary, segments, mask));
  return add(g, x, mlp_(g, ffn_norm_(g, x)));
}

Decoder::Decoder(const Scope& s, DecoderFamily family, DecoderOutput output)
    : path_(s.path()),
      d_model_(s.dim("d_model")),
      heads_(Heads::read(s, family.rope_angle)),
      token_embd_(s / "token_embd", d_model_, s.dim("n_vocab", 1 << 24)) {
  const int n_layer = s.n_layer("n_layer"), d_ff = s.dim("d_ff");
  const float eps = s.number("norm_eps", kNormEps);
  const bool answers = output == DecoderOutput::logits;
  for (int i = 0; i < (answers ? n_layer : n_layer - 1); ++i)
    blocks_.emplace_back(s / "blk" / i, d_model_, d_ff, heads_, family.activation, eps);
  if (answers) {
    norm_.emplace(s / "norm", d_model_, eps);
    head_.emplace(s / "head", d_model_, s.dim("n_vocab", 1 << 24), Bias::no);
    return;
  }
  const Scope last = s / "blk" / (n_layer - 1);
  last_norm_.emplace(last / "attn_norm", d_model_, eps);
  last_kv_.emplace(last, d_model_, heads_);
}

std::string Decoder::layer_path(int i_layer) const { return fmt::format("{}.blk.{}", path_, i_layer); }

void Decoder::prefill(Graph& g, Tensor x, Tensor mask, Cache& cache) const {
  const Tensor rotary = heads_.rotary(g, 0, static_cast<int>(x.dim(1)));
  for (const DecoderBlock& block : blocks_) x = block(g, x, rotary, mask, cache);
  if (last_kv_)
    put(g, cache, layer_path(n_layer() - 1), (*last_kv_)(g, (*last_norm_)(g, x), rotary));
  else
    cache.put(g, "logits", logits(g, slice_tokens(g, x, static_cast<int>(x.dim(1)) - 1, 1)));
}

Tensor Decoder::logits(Graph& g, Tensor x) const { return (*head_)(g, (*norm_)(g, x)); }

Tensor Decoder::next(Graph& g, Tensor x, Tensor k, int n_token, Cache& cache) const {
  const int n_prefix = static_cast<int>(cached(g, cache, 0).key.dim(2));
  const Tensor rotary = column(g, heads_.rotary(g, n_prefix, n_token), k);
  const Tensor here = column(g, identity(g, n_token), k), mask = column(g, causal_mask(g, n_prefix, n_token), k);
  const auto along_tokens = [&](Tensor row) { return reshape(g, row, {1, 1, n_token, 1}); };
  const Tensor one = full(g, 1, n_token, 1);
  const AppendPlace place = {along_tokens(here), along_tokens(add(g, one, scale(g, here, -1)))};
  for (const DecoderBlock& block : blocks_) x = block.next(g, x, rotary, mask, place, cache);
  return logits(g, x);
}

KeyValue Decoder::cached(Graph& g, const Cache& cache, int i_layer) const { return get(g, cache, layer_path(i_layer)); }

}  // namespace vla
