// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/vision/siglip2.h"

#include <fmt/format.h>

#include "modules/vision/patch_grid.h"
#include "nn/tokens.h"

namespace vla {

Siglip2::Siglip2(const Scope& s)
    : d_model_(s.dim("d_model")),
      width_(s.dim("image_width", 16384)),
      height_(s.dim("image_height", 16384)),
      patch_size_(s.dim("patch_size", 256)),
      n_side_(s.dim("n_position_side", 1024)),
      patch_embed_(s / "patch_embed", patch_size_, d_model_),
      position_(s / "position", d_model_, n_side_ * n_side_),
      post_norm_(s / "post_norm", d_model_, s.number("norm_eps", kNormEps)) {
  const int n_head = s.dim("n_head", 1024), d_ff = s.dim("d_ff"), n_layer = s.n_layer("n_layer");
  s.require(d_model_ % n_head == 0, "n_head", fmt::format("a divisor of d_model {}", d_model_), std::to_string(n_head));
  s.require(width_ % patch_size_ == 0, "image_width", fmt::format("a multiple of patch_size {}", patch_size_),
            std::to_string(width_));
  s.require(height_ % patch_size_ == 0, "image_height", fmt::format("a multiple of patch_size {}", patch_size_),
            std::to_string(height_));
  for (int i = 0; i < n_layer; ++i)
    blocks_.emplace_back(s / "blk" / i, d_model_, n_head, d_ff, s.number("norm_eps", kNormEps));
}

Status Siglip2::check(int width, int height) const {
  if (width == width_ && height == height_) return {};
  return Error{Code::unsupported, "vision.image_width", fmt::format("images of {} x {}", width_, height_),
               fmt::format("{} x {}", width, height)};
}

void Siglip2::keep(Graph& g, Cache& cache) const {
  cache.put(g, position_.path(), blended(g, position_, resize_positions(n_row(), n_column(), n_side_)));
}

Tensor Siglip2::operator()(Graph& g, Tensor images, const Cache& cache) const {
  Tensor x = add(g, patch_embed_(g, images), cache.get(g, position_.path()));
  for (const EncoderBlock& block : blocks_) x = block(g, x);
  return post_norm_(g, x);
}

}  // namespace vla
