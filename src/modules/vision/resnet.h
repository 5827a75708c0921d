// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <vector>

#include "nn/convolution.h"

namespace vla {

/// Two 3 x 3 convolutions and a shortcut, which is a 1 x 1 convolution if width or size change:
/// relu(conv2(relu(conv1(x))) + shortcut(x)). x [d_in, width, height, n_view] -> [d_out, n_column, n_row, n_view].
/// Source: torchvision models/resnet.py BasicBlock.
class ResNetBlock : public Module<ResNetBlock> {
 public:
  ResNetBlock(const Scope& s, int d_in, int d_out, int stride);
  Tensor forward(Graph& g, Tensor x) const;

 private:
  Convolution first_, second_;
  std::optional<Convolution> shortcut_;
};

/// ResNet-18 and -34 up to their last feature map. vla-convert folds the frozen batch norms into the weights. Source:
/// torchvision models/resnet.py ResNet, without avgpool and fc.
class ResNet {
 public:
  /// Reads `n_block`, the blocks of each of the four stages, and `image_width` and `image_height`.
  explicit ResNet(const Scope& s);
  /// Checks that images have the size that the network was trained with. Errors: unsupported.
  Status check(int width, int height) const;
  static constexpr int kWidth = 512;  // channels of the last stage
  int d_model() const { return kWidth; }
  /// Cells of the last feature map along a side of that many pixels. The first convolution, the pooling and the first
  /// block of three stages have a stride of two.
  static int n_cell(int n_pixel) { return (n_pixel + 31) / 32; }
  /// images [width, height, 3, n_view] -> [d_model, n_column, n_row, n_view].
  Tensor operator()(Graph& g, Tensor images) const;

 private:
  int width_, height_;
  Convolution stem_;
  std::vector<ResNetBlock> blocks_;
};

}  // namespace vla
