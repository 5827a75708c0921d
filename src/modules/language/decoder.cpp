// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/language/decoder.h"

#include <fmt/format.h>

#include "nn/tokens.h"

namespace vla {

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
  x = add(g, x, attention_(g, h, rotary, {kv}, mask));
  return add(g, x, mlp_(g, ffn_norm_(g, x)));
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
  const Tensor rotary = heads_.rotary(g, 0, static_cast<int>(x.dim(1)));
  for (const DecoderBlock& block : blocks_) x = block(g, x, rotary, mask, cache);
  put(g, cache, layer_path(n_layer() - 1), (*last_kv_)(g, (*last_norm_)(g, x), rotary));
}

KeyValue Decoder::cached(Graph& g, const Cache& cache, int i_layer) const { return get(g, cache, layer_path(i_layer)); }

}  // namespace vla
