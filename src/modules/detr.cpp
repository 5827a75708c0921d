// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/detr.h"

#include <fmt/format.h>

namespace vla {
namespace {

Tensor placed(Graph& g, Tensor x, Tensor position) { return position ? add(g, x, position) : x; }

}  // namespace

DetrFamily DetrFamily::read(const Scope& s) {
  DetrFamily family = {
      s.dim("d_model"), s.dim("n_head", 1024), s.dim("d_ff"), Activation::none, false, s.number("norm_eps", kNormEps)};
  family.activation = s.choice("activation", {"relu", "gelu_erf"}) == 0 ? Activation::relu : Activation::gelu_erf;
  family.pre_norm = s.choice("norm", {"after", "before"}) == 1;
  s.require(family.d_model % family.n_head == 0, "n_head", fmt::format("a divisor of d_model {}", family.d_model),
            std::to_string(family.n_head));
  return family;
}

Tensor PlacedAttention::operator()(Graph& g, Tensor x, Tensor position, Tensor mask) const {
  return norm_(g, x, [&](Tensor h) {
    const Tensor x_placed = placed(g, h, position);
    return attention_(g, x_placed, {}, {attention_.project()(g, x_placed, h, {})}, mask);
  });
}

DetrEncoderLayer::DetrEncoderLayer(const Scope& s, const DetrFamily& family)
    : Module(s),
      among_(s, family),
      ffn_norm_(s / "ffn_norm", family),
      mlp_(s, family.d_model, family.d_ff, family.activation) {}

Tensor DetrEncoderLayer::forward(Graph& g, Tensor x, Tensor position, Tensor mask) const {
  return ffn_norm_(g, among_(g, x, position, mask), [&](Tensor h) { return mlp_(g, h); });
}

DetrDecoderLayer::DetrDecoderLayer(const Scope& s, const DetrFamily& family)
    : Module(s),
      among_(s, family),
      cross_norm_(s / "cross" / "attn_norm", family),
      cross_(s / "cross", family.d_model, family.d_model, PlacedAttention::heads(family)),
      ffn_norm_(s / "ffn_norm", family),
      mlp_(s, family.d_model, family.d_ff, family.activation) {}

KeyValue DetrDecoderLayer::project(Graph& g, Tensor tokens, Tensor position) const {
  return cross_.project()(g, placed(g, tokens, position), tokens, {});
}

Tensor DetrDecoderLayer::forward(Graph& g, Tensor x, Tensor position, const KeyValue& seen) const {
  x = cross_norm_(g, x, [&](Tensor h) { return cross_(g, placed(g, h, position), {}, {seen}); });
  return ffn_norm_(g, x, [&](Tensor h) { return mlp_(g, h); });
}

DetrDecoder::DetrDecoder(const Scope& s, const DetrFamily& family, int n_layer) {
  for (int i = 0; i < n_layer; ++i) layers_.emplace_back(s / "blk" / i, family);
}

void DetrDecoder::constants(Graph& g, Tensor queries, Tensor position, Cache& cache) const {
  cache.put(g, "queries", layers_.front().among(g, queries, position));
}

void DetrDecoder::prefix(Graph& g, Tensor tokens, Tensor position, Cache& cache) const {
  for (const DetrDecoderLayer& layer : layers_) put(g, cache, layer.path(), layer.project(g, tokens, position));
}

Tensor DetrDecoder::operator()(Graph& g, Tensor position, const Cache& cache) const {
  Tensor x = cache.get(g, "queries");
  for (const DetrDecoderLayer& layer : layers_) {
    if (&layer != &layers_.front()) x = layer.among(g, x, position);
    x = layer(g, x, position, get(g, cache, layer.path()));
  }
  return x;
}

}  // namespace vla
