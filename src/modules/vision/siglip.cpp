// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/vision/siglip.h"

#include <fmt/format.h>

#include "modules/vision/position_ids.h"
#include "nn/tokens.h"

namespace vla {

Siglip::Siglip(const Scope& s, EncoderFamily family, bool post_norm, int d_condition)
    : d_model_(s.dim("d_model")),
      patch_size_(s.dim("patch_size", 256)),
      n_table_(std::max(1, s.dim("image_size", 16384) / patch_size_)),
      position_rule_(s.string("position_rule")),
      patch_embed_(s / "patch_embed", patch_size_, d_model_),
      position_(s / "position", d_model_, n_position()) {
  const int n_head = s.dim("n_head", 1024), d_ff = s.dim("d_ff"), n_layer = s.n_layer("n_layer");
  s.require(d_model_ % n_head == 0, "n_head", fmt::format("a divisor of d_model {}", d_model_), std::to_string(n_head));
  for (int i = 0; i < n_layer; ++i)
    blocks_.emplace_back(s / "blk" / i, d_model_, n_head, d_ff, s.number("norm_eps", kNormEps), family, d_condition);
  if (post_norm) post_norm_.emplace(s / "post_norm", d_model_, s.number("norm_eps", kNormEps));
}

Status Siglip::check(int width, int height) const {
  if (width != height || width < patch_size_)
    return Error{Code::unsupported, "vision", fmt::format("a square image of {} pixels or more", patch_size_),
                 fmt::format("{} x {}", width, height)};
  const auto ids = vision_position_ids(position_rule_, width / patch_size_, n_table_);
  return ids ? Status() : Status(ids.error());
}

Tensor Siglip::operator()(Graph& g, Tensor images, Tensor condition) const {
  Tensor x = patch_embed_(g, images);
  const Tensor ids = g.constant_ids("vision_position_ids", [&] {
    return *vision_position_ids(position_rule_, static_cast<int>(images.dim(0)) / patch_size_, n_table_);
  });
  x = add(g, x, position_(g, ids));
  for (const EncoderBlock& block : blocks_) x = block(g, x, Tensor(), condition);
  return post_norm_ ? (*post_norm_)(g, x) : x;
}

}  // namespace vla
