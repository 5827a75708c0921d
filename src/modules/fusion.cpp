// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/fusion.h"

namespace vla {

FusionLayer::Side::Side(const Scope& s, const DetrFamily& family)
    : Module(s),
      attn_norm_(s / "attn_norm", family.d_model, family.norm_eps),
      attention_(s, family.d_model, family.d_model, PlacedAttention::heads(family)),
      ffn_norm_(s / "ffn_norm", family),
      mlp_(s, family.d_model, family.d_ff, family.activation) {}

Tensor FusionLayer::Side::forward(Graph& g, Tensor x, Tensor normed, Tensor other) const {
  x = add(g, x, attention_(g, normed, {}, {attention_.project()(g, other)}));
  return ffn_norm_(g, x, [&](Tensor h) { return mlp_(g, h); });
}

Streams FusionLayer::operator()(Graph& g, const Streams& x) const {
  const Tensor image = image_.norm(g, x.image), text = text_.norm(g, x.text);
  const Tensor image_out = image_(g, x.image, image, text);
  return {image_out, text_(g, x.text, text, image)};
}

}  // namespace vla
