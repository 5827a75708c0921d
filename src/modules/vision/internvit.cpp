// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/vision/internvit.h"

#include <fmt/format.h>

#include <algorithm>

#include "nn/adaptive_norm.h"
#include "nn/attention.h"
#include "nn/tokens.h"

namespace vla {

InternVitBlock::InternVitBlock(const Scope& s, int d_model, int n_head, int d_ff, float eps)
    : Module(s),
      n_head_(n_head),
      attn_norm_(s / "attn_norm", d_model, eps),
      q_(s / "attn_q", d_model, d_model, Bias::yes),
      k_(s / "attn_k", d_model, d_model, Bias::yes),
      v_(s / "attn_v", d_model, d_model, Bias::yes),
      out_(s / "attn_out", d_model, d_model, Bias::yes),
      attn_scale_((s / "attn_scale").vector("weight", d_model)),
      ffn_norm_(s / "ffn_norm", d_model, eps),
      mlp_(s, d_model, d_ff, Activation::gelu_erf),
      ffn_scale_((s / "ffn_scale").vector("weight", d_model)) {}

Tensor InternVitBlock::forward(Graph& g, Tensor x) const {
  const Tensor h = attn_norm_(g, x);
  std::vector<Tensor> qkv = Linear::group(g, {&q_, &k_, &v_}, h);
  for (Tensor& part : qkv) part = split_heads(g, part, n_head_);
  x = gated_add(g, x, out_(g, attention(g, qkv[0], qkv[1], qkv[2], {})), g.weight(attn_scale_));
  return gated_add(g, x, mlp_(g, ffn_norm_(g, x)), g.weight(ffn_scale_));
}

InternVit::InternVit(const Scope& s)
    : d_model_(s.dim("d_model")),
      image_size_(s.dim("image_size", 16384)),
      n_side_(std::max(1, image_size_ / s.dim("patch_size", 256))),
      class_token_((s / "class_token").vector("weight", d_model_)),
      patch_embed_(s / "patch_embed", s.dim("patch_size", 256), d_model_),
      position_(s / "position", d_model_, 1 + n_side_ * n_side_) {
  const int n_head = s.dim("n_head", 1024), d_ff = s.dim("d_ff"), n_layer = s.n_layer("n_layer");
  s.require(d_model_ % n_head == 0, "n_head", fmt::format("a divisor of d_model {}", d_model_), std::to_string(n_head));
  for (int i = 0; i < n_layer; ++i) blocks_.emplace_back(s / "blk" / i, d_model_, n_head, d_ff, s.number("norm_eps"));
}

Status InternVit::check(int width, int height) const {
  if (width == image_size_ && height == image_size_) return {};
  return Error{Code::unsupported, "vision.image_size", fmt::format("pictures of {0} x {0}", image_size_),
               fmt::format("{} x {}", width, height)};
}

Tensor InternVit::operator()(Graph& g, Tensor images) const {
  Tensor x = prepend_token(g, g.weight(class_token_), patch_embed_(g, images));
  x = add(g, x, position_(g, counting_ids(g, static_cast<int>(x.dim(1)))));
  for (const InternVitBlock& block : blocks_) x = block(g, x);
  return drop_first_token(g, x);
}

}  // namespace vla
