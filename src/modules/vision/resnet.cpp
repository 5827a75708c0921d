// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/vision/resnet.h"

#include <fmt/format.h>

#include "nn/tokens.h"

namespace vla {
namespace {

constexpr int kStemWidth = 64, kStages = 4;

}  // namespace

ResNetNorm ResNetNorm::read(const Scope& s) {
  if (!s.has("group_width")) return {};
  return {s.dim("group_width", kStemWidth), s.number("norm_eps", kNormEps)};
}

NormedConvolution::NormedConvolution(const Scope& s, const Scope& norm, int d_in, int d_out, int size, int stride,
                                     ResNetNorm of)
    : convolution_(s, d_in, d_out, size, stride, of.group_width > 0 ? Bias::no : Bias::yes) {
  if (of.group_width > 0) norm_.emplace(norm, d_out, d_out / of.group_width, of.eps);
}

Tensor NormedConvolution::operator()(Graph& g, Tensor x) const {
  const Tensor y = convolution_(g, x);
  return norm_ ? (*norm_)(g, y) : y;
}

ResNetBlock::ResNetBlock(const Scope& s, int d_in, int d_out, int stride, ResNetNorm norm)
    : Module(s),
      first_(s / "conv1", s / "norm1", d_in, d_out, 3, stride, norm),
      second_(s / "conv2", s / "norm2", d_out, d_out, 3, 1, norm) {
  if (stride != 1 || d_in != d_out)
    shortcut_.emplace(s / "shortcut", s / "shortcut_norm", d_in, d_out, 1, stride, norm);
}

Tensor ResNetBlock::forward(Graph& g, Tensor x) const {
  const Tensor beside = shortcut_ ? (*shortcut_)(g, x) : x;
  const Tensor y = second_(g, activate(g, first_(g, x), Activation::relu));
  return activate(g, add(g, y, beside), Activation::relu);
}

ResNet::ResNet(const Scope& keys, const Scope& s)
    : width_(keys.dim("image_width", 16384)),
      height_(keys.dim("image_height", 16384)),
      stem_(s / "stem", s / "stem_norm", 3, kStemWidth, 7, 2, ResNetNorm::read(keys)) {
  std::vector<int> n_block = keys.integers("n_block", {1, 64});
  keys.require(n_block.size() == kStages, "n_block", "the blocks of four stages", std::to_string(n_block.size()));
  n_block.resize(kStages, 1);
  int d_in = kStemWidth, index = 0;
  for (int stage = 0; stage < kStages; ++stage)
    for (int i = 0; i < n_block[static_cast<std::size_t>(stage)]; ++i) {
      const int d_out = kStemWidth << stage;
      blocks_.emplace_back(s / "blk" / index++, d_in, d_out, i == 0 && stage > 0 ? 2 : 1, ResNetNorm::read(keys));
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
