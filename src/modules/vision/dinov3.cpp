// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/vision/dinov3.h"

#include <fmt/format.h>

#include <algorithm>

#include "nn/rope.h"
#include "nn/tokens.h"

namespace vla {

DinoV3::DinoV3(const Scope& s, bool normed)
    : d_model_(s.dim("d_model")),
      n_head_(s.dim("n_head", 1024)),
      image_size_(s.dim("image_size", 16384)),
      n_side_(std::max(1, image_size_ / s.dim("patch_size", 256))),
      n_register_(s.index("n_register", 1024)),
      rope_base_(s.number("rope_base", kRopeBase)),
      class_token_((s / "class_token").vector("weight", d_model_)),
      patch_embed_(s / "patch_embed", s.dim("patch_size", 256), d_model_) {
  if (normed) post_norm_.emplace(s / "post_norm", d_model_, s.number("norm_eps", kNormEps));
  const int d_ff = s.dim("d_ff"), n_layer = s.n_layer("n_layer");
  s.require(d_model_ % (4 * n_head_) == 0, "n_head",
            fmt::format("a divisor of d_model {} that leaves heads of a multiple of 4", d_model_),
            std::to_string(n_head_));
  if (n_register_ > 0) registers_.emplace(s / "registers", d_model_, n_register_);
  for (int i = 0; i < n_layer; ++i)
    blocks_.emplace_back(s / "blk" / i, d_model_, n_head_, d_ff, s.number("norm_eps", kNormEps), kDinoEncoder);
}

Status DinoV3::check(int width, int height) const {
  if (width == image_size_ && height == image_size_) return {};
  return Error{Code::unsupported, "vision.image_size", fmt::format("images of {0} x {0}", image_size_),
               fmt::format("{} x {}", width, height)};
}

Tensor DinoV3::operator()(Graph& g, Tensor images) const {
  const Tensor patches = patch_embed_(g, images);
  std::vector<Tensor> tokens = {g.parameter(class_token_)};
  if (registers_) tokens.push_back((*registers_)(g, arange(g, n_register_)));
  Tensor x = prepend_tokens(g, concat_tokens(g, tokens), patches);
  const int n_first = 1 + n_register_;
  const Tensor rotary = centre_rotary_table(g, d_model_ / n_head_, rope_base_, n_first, n_side_, n_side_);
  for (const EncoderBlock& block : blocks_) x = block(g, x, rotary);
  const Tensor seen = slice_tokens(g, x, n_first, n_patch());
  return post_norm_ ? (*post_norm_)(g, seen) : seen;
}

}  // namespace vla
