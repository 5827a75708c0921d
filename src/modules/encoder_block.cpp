// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/encoder_block.h"

#include "nn/adaptive_norm.h"

namespace vla {
namespace {

Heads heads(int d_model, int n_head, const EncoderFamily& family) {
  Heads even = Heads::even(d_model, n_head, family.rule);
  even.plain_keys = family.plain_keys;
  return even;
}

}  // namespace

Film::Film(const Scope& s, int d_condition, int d_model)
    : scale_(s / "film_scale", d_condition, d_model, Bias::yes),
      shift_(s / "film_shift", d_condition, d_model, Bias::yes) {}

Tensor Film::operator()(Graph& g, Tensor x, Tensor condition) const {
  const Tensor scaled = multiply(g, x, scale_(g, condition));
  return add(g, scaled, shift_(g, condition));
}

EncoderBlock::EncoderBlock(const Scope& s, int d_model, int n_head, int d_ff, float eps, EncoderFamily family,
                           int d_condition)
    : Module(s),
      attn_norm_(s / "attn_norm", d_model, eps),
      attention_(s, d_model, d_model, heads(d_model, n_head, family)),
      ffn_norm_(s / "ffn_norm", d_model, eps),
      mlp_(s, d_model, d_ff, family.activation, family.rule) {
  if (d_condition > 0) film_.emplace(s, d_condition, d_model);
  if (!family.scaled) return;
  attn_scale_ = (s / "attn_scale").vector("weight", d_model);
  ffn_scale_ = (s / "ffn_scale").vector("weight", d_model);
}

Tensor EncoderBlock::forward(Graph& g, Tensor x, Tensor rotary, Tensor condition) const {
  const auto residual = [&](Tensor y, const Param* scale) {
    return scale != nullptr ? gated_add(g, x, y, g.parameter(scale)) : add(g, x, y);
  };
  x = residual(attention_.among(g, attn_norm_(g, x), rotary), attn_scale_);
  if (film_) x = (*film_)(g, x, condition);
  return residual(mlp_(g, ffn_norm_(g, x)), ffn_scale_);
}

}  // namespace vla
