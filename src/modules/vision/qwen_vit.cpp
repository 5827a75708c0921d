// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/vision/qwen_vit.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>

#include "modules/vision/patch_grid.h"
#include "nn/tokens.h"

namespace vla {

QwenVit::QwenVit(const Scope& s)
    : d_model_(s.dim("d_model")),
      n_head_(s.dim("n_head", 1024)),
      width_(s.dim("image_width", 16384)),
      height_(s.dim("image_height", 16384)),
      patch_size_(s.dim("patch_size", 256)),
      merge_(s.dim("merge", 8)),
      n_row_(height_ / patch_size_),
      n_column_(width_ / patch_size_),
      n_side_(s.dim("n_position_side", 1024)),
      norm_eps_(s.number("norm_eps", kNormEps)),
      rope_base_(s.number("rope_base", kRopeBase)),
      deepstack_layers_(s.integers("deepstack_layers", {0, 511})),
      patch_embed_(s / "patch_embed", 3 * patch_size_ * patch_size_, d_model_, Bias::yes),
      patch_embed_next_(s / "patch_embed_next", 3 * patch_size_ * patch_size_, d_model_, Bias::no),
      position_(s / "position", d_model_, n_side_ * n_side_) {
  const int n_layer = s.n_layer("n_layer"), d_ff = s.dim("d_ff"), unit = patch_size_ * merge_;
  s.require(d_model_ % (4 * n_head_) == 0, "n_head",
            fmt::format("a divisor of d_model {} that leaves heads of a multiple of 4", d_model_),
            std::to_string(n_head_));
  s.require(width_ % unit == 0, "image_width", fmt::format("a multiple of patch_size * merge {}", unit),
            std::to_string(width_));
  s.require(height_ % unit == 0, "image_height", fmt::format("a multiple of patch_size * merge {}", unit),
            std::to_string(height_));
  const bool in_order = std::adjacent_find(deepstack_layers_.begin(), deepstack_layers_.end(),
                                           std::greater_equal<>()) == deepstack_layers_.end();
  s.require(in_order && (deepstack_layers_.empty() || deepstack_layers_.back() < n_layer), "deepstack_layers",
            fmt::format("layers in order, below n_layer {}", n_layer),
            fmt::format("{}", fmt::join(deepstack_layers_, " ")));
  for (int i = 0; i < n_layer; ++i) blocks_.emplace_back(s / "blk" / i, d_model_, n_head_, d_ff, norm_eps_);
}

std::vector<PositionId> QwenVit::places() const { return merge_block_places(n_row_, n_column_, merge_); }

Status QwenVit::check(int width, int height) const {
  if (width == width_ && height == height_) return {};
  return Error{Code::unsupported, "vision.image_width", fmt::format("images of {} x {}", width_, height_),
               fmt::format("{} x {}", width, height)};
}

void QwenVit::keep(Graph& g, Cache& cache) const {
  cache.put(g, position_.path(), blended(g, position_, blend_positions(places(), n_row_, n_column_, n_side_)));
}

std::vector<Tensor> QwenVit::operator()(Graph& g, Tensor images, const Cache& cache) const {
  const Tensor pixels = patches(g, images, patch_size_);
  const Tensor ordered = reshape_width(g, pixel_shuffle(g, pixels, n_column_, merge_), pixels.dim(0));
  Tensor x = add(g, patch_embed_.forward(g, ordered), patch_embed_next_(g, ordered));
  x = add(g, g.name(patch_embed_.path(), x), cache.get(g, position_.path()));
  const Tensor rotary = grid_rotary_table(g, d_model_ / n_head_, rope_base_, places());
  std::vector<Tensor> seen;
  for (std::size_t i = 0; i < blocks_.size(); ++i) {
    x = blocks_[i](g, x, rotary);
    if (std::find(deepstack_layers_.begin(), deepstack_layers_.end(), static_cast<int>(i)) != deepstack_layers_.end())
      seen.push_back(x);
  }
  seen.push_back(x);
  return seen;
}

}  // namespace vla
