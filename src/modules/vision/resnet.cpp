// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/vision/resnet.h"

#include <fmt/format.h>

#include "nn/tokens.h"

namespace vla {
namespace {

constexpr int kStemWidth = 64, kStages = 4;

}  // namespace

ResNetBlock::ResNetBlock(const Scope& s, int d_in, int d_out, int stride)
    : Module(s), first_(s / "conv1", d_in, d_out, 3, stride), second_(s / "conv2", d_out, d_out, 3, 1) {
  if (stride != 1 || d_in != d_out) shortcut_.emplace(s / "shortcut", d_in, d_out, 1, stride);
}

Tensor ResNetBlock::forward(Graph& g, Tensor x) const {
  const Tensor beside = shortcut_ ? (*shortcut_)(g, x) : x;
  const Tensor y = second_(g, activate(g, first_(g, x), Activation::relu));
  return activate(g, add(g, y, beside), Activation::relu);
}

ResNet::ResNet(const Scope& s)
    : width_(s.dim("image_width", 16384)),
      height_(s.dim("image_height", 16384)),
      stem_(s / "stem", 3, kStemWidth, 7, 2) {
  std::vector<int> n_block = s.integers("n_block", {1, 64});
  s.require(n_block.size() == kStages, "n_block", "the blocks of four stages", std::to_string(n_block.size()));
  n_block.resize(kStages, 1);
  int d_in = kStemWidth, index = 0;
  for (int stage = 0; stage < kStages; ++stage)
    for (int i = 0; i < n_block[static_cast<std::size_t>(stage)]; ++i) {
      const int d_out = kStemWidth << stage;
      blocks_.emplace_back(s / "blk" / index++, d_in, d_out, i == 0 && stage > 0 ? 2 : 1);
      d_in = d_out;
    }
}

Status ResNet::check(int width, int height) const {
  if (width == width_ && height == height_) return {};
  return Error{Code::unsupported, "vision.image_width", fmt::format("images of {} x {}", width_, height_),
               fmt::format("{} x {}", width, height)};
}

Tensor ResNet::operator()(Graph& g, Tensor images) const {
  Tensor x = activate(g, stem_(g, pixels_first(g, images)), Activation::relu);
  x = max_pool(g, x, 3, 2);
  for (const ResNetBlock& block : blocks_) x = block(g, x);
  return x;
}

}  // namespace vla
