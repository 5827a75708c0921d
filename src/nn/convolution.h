// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "nn/linear.h"

namespace vla {

/// Reorders pixels so that features come first: [width, height, d, n_view] -> [d, width, height, n_view], for d = 3.
Tensor pixels_first(Graph& g, Tensor images);

/// A convolution with bias, computed as a product over unfolded windows: x [d_in, width, height, n_view] -> [d_out,
/// n_column, n_row, n_view], with size / 2 zeros of padding on each side. Matrix columns are ordered by row, column,
/// feature. Source: torch.nn.Conv2d(padding = kernel_size // 2).
class Convolution : public Module<Convolution> {
 public:
  Convolution(const Scope& s, int d_in, int d_out, int size, int stride);
  Tensor forward(Graph& g, Tensor x) const;

 private:
  op::Window window_;
  Linear product_;
};

/// A depthwise convolution with bias: x [d, width, height, n_view] -> the same shape, with size / 2 zeros of padding on
/// each side. `kernel` is ordered by row, column, feature. Source: torch.nn.Conv2d(groups = d, padding = size // 2).
class DepthwiseConvolution : public Module<DepthwiseConvolution> {
 public:
  /// `size` is odd.
  DepthwiseConvolution(const Scope& s, int d, int size)
      : Module(s),
        window_{size, 1, size / 2},
        weight_(s.vector("kernel", size * size * d)),
        bias_(s.vector("bias", d)) {}
  Tensor forward(Graph& g, Tensor x) const {
    return g.add(op::Depthwise{window_}, {x, g.parameter(weight_), g.parameter(bias_)});
  }

 private:
  op::Window window_;
  const Param *weight_, *bias_;
};

/// Max pooling: x [d, width, height, n_view] -> [d, n_column, n_row, n_view]. Source: torch.nn.MaxPool2d(padding =
/// kernel_size // 2).
Tensor max_pool(Graph& g, Tensor x, int size, int stride);

}  // namespace vla
