// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <vector>

#include "nn/convolution.h"
#include "nn/group_norm.h"

namespace vla {

/// The norm after each convolution: group norm over `group_width` features, or if that is 0 a frozen batch norm, which
/// vla-convert folds into the weights.
struct ResNetNorm {
  int group_width = 0;
  float eps = 0;
  /// Reads `group_width` and `norm_eps`; both are 0 without the key `group_width`.
  static ResNetNorm read(const Scope& s);
};

/// A convolution and the norm after it; `norm` is the norm's path.
class NormedConvolution {
 public:
  NormedConvolution(const Scope& s, const Scope& norm, int d_in, int d_out, int size, int stride, ResNetNorm of);
  Tensor operator()(Graph& g, Tensor x) const;

 private:
  Convolution convolution_;
  std::optional<GroupNorm> norm_;
};

/// Two 3 x 3 convolutions and a shortcut, which is a 1 x 1 convolution if width or size change:
/// relu(conv2(relu(conv1(x))) + shortcut(x)). x [d_in, width, height, n_view] -> [d_out, n_column, n_row, n_view].
/// Source: torchvision models/resnet.py BasicBlock.
class ResNetBlock : public Module<ResNetBlock> {
 public:
  ResNetBlock(const Scope& s, int d_in, int d_out, int stride, ResNetNorm norm);
  Tensor forward(Graph& g, Tensor x) const;

 private:
  NormedConvolution first_, second_;
  std::optional<NormedConvolution> shortcut_;
};

/// ResNet-18 and -34 up to their last feature map. Sources: torchvision models/resnet.py ResNet, without avgpool and
/// fc; lerobot policies/diffusion/modeling_diffusion.py _replace_submodules (groups).
class ResNet {
 public:
  /// Reads `n_block`, the blocks of each of the four stages, `image_width` and `image_height`, and the norm.
  explicit ResNet(const Scope& s) : ResNet(s, s) {}
  /// Reads keys from the path `keys` and weights from the path `s`.
  ResNet(const Scope& keys, const Scope& s);
  /// Checks that images have the size that the network was trained with. Errors: unsupported.
  Status check(int width, int height) const;
  static constexpr int kWidth = 512;  // channels of the last stage
  int d_model() const { return kWidth; }
  /// Cells of the last feature map along a side of `n_pixel` pixels. The first convolution, the pooling and the first
  /// block of three stages have a stride of two.
  static int n_cell(int n_pixel) { return (n_pixel + 31) / 32; }
  /// Cells of the last feature map of an image.
  int n_cell() const { return n_cell(width_) * n_cell(height_); }
  /// images [width, height, 3, n_view] -> [d_model, n_column, n_row, n_view].
  Tensor operator()(Graph& g, Tensor images) const;

 private:
  int width_, height_;
  NormedConvolution stem_;
  std::vector<ResNetBlock> blocks_;
};

}  // namespace vla
