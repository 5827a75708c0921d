// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/vision/dinov2.h"

#include <fmt/format.h>

#include <algorithm>

#include "nn/tokens.h"

namespace vla {

DinoV2::DinoV2(const Scope& s, int d_condition)
    : path_(s.path()),
      d_model_(s.dim("d_model")),
      image_size_(s.dim("image_size", 16384)),
      n_side_(std::max(1, image_size_ / s.dim("patch_size", 256))),
      n_register_(s.index("n_register", 1024)),
      class_token_((s / "class_token").vector("weight", d_model_)),
      patch_embed_(s / "patch_embed", s.dim("patch_size", 256), d_model_),
      position_(s / "position", d_model_, n_patch()) {
  const int n_head = s.dim("n_head", 1024), d_ff = s.dim("d_ff"), n_layer = s.n_layer("n_layer");
  s.require(d_model_ % n_head == 0, "n_head", fmt::format("a divisor of d_model {}", d_model_), std::to_string(n_head));
  if (n_register_ > 0) registers_.emplace(s / "registers", d_model_, n_register_);
  for (int i = 0; i < n_layer; ++i)
    blocks_.emplace_back(s / "blk" / i, d_model_, n_head, d_ff, s.number("norm_eps", kNormEps), kInternEncoder,
                         d_condition);
}

Status DinoV2::check(int width, int height) const {
  if (width == image_size_ && height == image_size_) return {};
  return Error{Code::unsupported, path_ + ".image_size", fmt::format("images of {0} x {0}", image_size_),
               fmt::format("{} x {}", width, height)};
}

Tensor DinoV2::operator()(Graph& g, Tensor images, Tensor condition) const {
  const Tensor embedded = patch_embed_(g, images);
  const Tensor patches = add(g, embedded, position_(g, arange(g, n_patch())));
  std::vector<Tensor> tokens = {g.parameter(class_token_)};
  if (registers_) tokens.push_back((*registers_)(g, arange(g, n_register_)));
  Tensor x = prepend_tokens(g, concat_tokens(g, tokens), patches);
  for (const EncoderBlock& block : blocks_) x = block(g, x, Tensor(), condition);
  return slice_tokens(g, x, 1 + n_register_, n_patch());
}

}  // namespace vla
