// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/action/expert.h"

#include <fmt/format.h>

#include "nn/attention.h"
#include "nn/tokens.h"

namespace vla {

ExpertSelfBlock::ExpertSelfBlock(const Scope& s, int d_model, int d_ff, const Heads& heads, float eps)
    : Module(s),
      attn_norm_(s / "attn_norm", d_model, eps),
      attention_(s, d_model, d_model, heads),
      ffn_norm_(s / "ffn_norm", d_model, eps),
      mlp_(s, d_model, d_ff, Activation::silu) {}

Tensor ExpertSelfBlock::forward(Graph& g, Tensor x, const KeyValue& prefix) const {
  const int n_prefix = static_cast<int>(prefix.key.dim(2)), horizon = static_cast<int>(x.dim(1));
  const Tensor h = attn_norm_(g, x), rotary = attention_.heads().rotary(g, n_prefix, horizon);
  const KeyValue own = attention_.project()(g, h, rotary);
  x = add(g, x, attention_(g, h, rotary, {prefix, own}, causal_mask(g, n_prefix, horizon)));
  return add(g, x, mlp_(g, ffn_norm_(g, x)));
}

ExpertCrossBlock::ExpertCrossBlock(const Scope& s, int d_model, int d_ff, const Heads& heads, float eps)
    : Module(s),
      attn_norm_(s / "attn_norm", d_model, eps),
      attention_(s, d_model, heads.d_key(), heads),
      ffn_norm_(s / "ffn_norm", d_model, eps),
      mlp_(s, d_model, d_ff, Activation::silu) {}

void ExpertCrossBlock::prepare(Graph& g, const KeyValue& prefix, Cache& cache) const {
  // Projects the cached keys as they are, with their rotation, as the reference does.
  put(g, cache, path(), attention_.project()(g, merge_heads(g, prefix.key), merge_heads(g, prefix.value), {}));
}

Tensor ExpertCrossBlock::forward(Graph& g, Tensor x, const Cache& cache) const {
  // Positions of a cross layer's queries start at 0, not after the prefix: forward_cross_attn_layer subtracts their
  // minimum.
  const Tensor rotary = attention_.heads().rotary(g, 0, static_cast<int>(x.dim(1)));
  x = add(g, x, attention_(g, attn_norm_(g, x), rotary, {get(g, cache, path())}));
  return add(g, x, mlp_(g, ffn_norm_(g, x)));
}

Expert::Expert(const Scope& s, const Decoder& lm)
    : lm_(lm), d_model_(s.dim("d_model")), norm_(s / "norm", d_model_, s.number("norm_eps", kNormEps)) {
  const std::vector<std::string> kinds = s.strings("layer_kinds");
  const int n_layer = s.n_layer("n_layer"), d_ff = s.dim("d_ff");
  const float eps = s.number("norm_eps", kNormEps);
  Heads heads = lm.heads();
  heads.rope_base = s.number("rope_base", kRopeBase);
  s.require(static_cast<int>(kinds.size()) == lm.n_layer(), "layer_kinds",
            fmt::format("{} entries, one per language layer", lm.n_layer()), std::to_string(kinds.size()));
  for (int i = 0; i < std::min(lm.n_layer(), static_cast<int>(kinds.size())); ++i) {
    const std::string& kind = kinds[static_cast<std::size_t>(i)];
    const Scope place = s / "blk" / static_cast<int>(layers_.size());
    if (kind == "self")
      layers_.push_back({i, ExpertSelfBlock(place, d_model_, d_ff, heads, eps)});
    else if (kind == "cross")
      layers_.push_back({i, ExpertCrossBlock(place, d_model_, d_ff, heads, eps)});
    else
      s.require(kind == "none", "layer_kinds", "self, cross or none", kind);
  }
  s.require(static_cast<int>(layers_.size()) == n_layer, "n_layer",
            fmt::format("{}, as layer_kinds counts", layers_.size()), std::to_string(n_layer));
}

void Expert::prepare(Graph& g, Cache& cache) const {
  for (const Layer& layer : layers_)
    if (const auto* cross = std::get_if<ExpertCrossBlock>(&layer.block))
      cross->prepare(g, lm_.cached(g, cache, layer.i_lm), cache);
}

Tensor Expert::operator()(Graph& g, Tensor x, const Cache& cache) const {
  for (const Layer& layer : layers_) {
    if (const auto* cross = std::get_if<ExpertCrossBlock>(&layer.block))
      x = (*cross)(g, x, cache);
    else
      x = std::get<ExpertSelfBlock>(layer.block)(g, x, lm_.cached(g, cache, layer.i_lm));
  }
  return norm_(g, x);
}

}  // namespace vla
