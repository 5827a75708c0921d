// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/encoder_block.h"

#include "nn/adaptive_norm.h"
#include "nn/attention.h"
#include "nn/rope.h"

namespace vla {

EncoderBlock::EncoderBlock(const Scope& s, int d_model, int n_head, int d_ff, float eps, EncoderFamily family)
    : Module(s),
      n_head_(n_head),
      attn_norm_(s / "attn_norm", d_model, eps),
      q_(s / "attn_q", d_model, d_model, Bias::yes),
      k_(s / "attn_k", d_model, d_model, Bias::yes),
      v_(s / "attn_v", d_model, d_model, Bias::yes),
      out_(s / "attn_out", d_model, d_model, Bias::yes),
      ffn_norm_(s / "ffn_norm", d_model, eps),
      mlp_(s, d_model, d_ff, family.activation) {
  if (!family.scaled) return;
  attn_scale_ = (s / "attn_scale").vector("weight", d_model);
  ffn_scale_ = (s / "ffn_scale").vector("weight", d_model);
}

Tensor EncoderBlock::forward(Graph& g, Tensor x, Tensor rotary) const {
  const Tensor h = attn_norm_(g, x);
  std::vector<Tensor> qkv = Linear::group(g, {&q_, &k_, &v_}, h);
  for (Tensor& part : qkv) part = split_heads(g, part, n_head_);
  if (rotary) qkv[0] = rope(g, qkv[0], rotary), qkv[1] = rope(g, qkv[1], rotary);
  const Tensor mixed = attention(g, qkv[0], qkv[1], qkv[2], {});
  x = attn_scale_ != nullptr ? gated_add(g, x, out_(g, mixed), g.weight(attn_scale_)) : out_.added_to(g, x, mixed);
  const Tensor normed = ffn_norm_(g, x);
  return ffn_scale_ != nullptr ? gated_add(g, x, mlp_(g, normed), g.weight(ffn_scale_)) : mlp_.added_to(g, x, normed);
}

}  // namespace vla
