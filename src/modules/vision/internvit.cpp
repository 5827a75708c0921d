// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/vision/internvit.h"

#include <fmt/format.h>

#include <algorithm>

#include "nn/tokens.h"

namespace vla {

InternVit::InternVit(const Scope& s)
    : d_model_(s.dim("d_model")),
      image_size_(s.dim("image_size", 16384)),
      n_side_(std::max(1, image_size_ / s.dim("patch_size", 256))),
      class_token_((s / "class_token").vector("weight", d_model_)),
      patch_embed_(s / "patch_embed", s.dim("patch_size", 256), d_model_),
      position_(s / "position", d_model_, 1 + n_side_ * n_side_) {
  const int n_head = s.dim("n_head", 1024), d_ff = s.dim("d_ff"), n_layer = s.n_layer("n_layer");
  s.require(d_model_ % n_head == 0, "n_head", fmt::format("a divisor of d_model {}", d_model_), std::to_string(n_head));
  for (int i = 0; i < n_layer; ++i)
    blocks_.emplace_back(s / "blk" / i, d_model_, n_head, d_ff, s.number("norm_eps", kNormEps), kInternEncoder);
}

Status InternVit::check(int width, int height) const {
  if (width == image_size_ && height == image_size_) return {};
  return Error{Code::unsupported, "vision.image_size", fmt::format("images of {0} x {0}", image_size_),
               fmt::format("{} x {}", width, height)};
}

Tensor InternVit::operator()(Graph& g, Tensor images) const {
  Tensor x = prepend_tokens(g, g.parameter(class_token_), patch_embed_(g, images));
  x = add(g, x, position_(g, arange(g, static_cast<int>(x.dim(1)))));
  for (const EncoderBlock& block : blocks_) x = block(g, x);
  return slice_tokens(g, x, 1, static_cast<int>(x.dim(1)) - 1);
}

}  // namespace vla
