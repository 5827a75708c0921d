// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "nn/linear.h"

namespace vla {

/// Reorders pixels so that features come first: [width, height, d, n_view] -> [d, width, height, n_view], for d = 3.
Tensor pixels_first(Graph& g, Tensor images);

/// A convolution, computed as a product over unfolded windows: x [d_in, width, height, n_view] -> [d_out,
/// n_column, n_row, n_view], with size / 2 zeros of padding on each side. Matrix columns are ordered by row, column,
/// feature. Source: torch.nn.Conv2d(padding = kernel_size // 2).
class Convolution : public Module<Convolution> {
 public:
  Convolution(const Scope& s, int d_in, int d_out, int size, int stride, Bias bias = Bias::yes);
  Tensor forward(Graph& g, Tensor x) const;

 private:
  op::Window window_;
  Linear product_;
};

/// A 1-D convolution with bias over the sequence of tokens: x [d_in, n] -> [d_out, n], with size / 2 zeros of padding
/// on each side. Matrix columns are ordered by place in the window, then by feature. Source: torch.nn.Conv1d(padding =
/// kernel_size // 2).
class TokenConvolution : public Module<TokenConvolution> {
 public:
  /// `size` is odd.
  TokenConvolution(const Scope& s, int d_in, int d_out, int size)
      : Module(s), size_(size), product_(s, size * d_in, d_out, Bias::yes) {}
  Tensor forward(Graph& g, Tensor x) const;

 private:
  int size_;
  Linear product_;
};

/// Halves an even number of tokens: x [d, n] -> [d, n / 2]. Matrix columns are ordered as in TokenConvolution. Source:
/// torch.nn.Conv1d(kernel_size = 3, stride = 2, padding = 1).
class HalvingConvolution : public Module<HalvingConvolution> {
 public:
  HalvingConvolution(const Scope& s, int d) : Module(s), product_(s, 3 * d, d, Bias::yes) {}
  Tensor forward(Graph& g, Tensor x) const;

 private:
  Linear product_;
};

/// Doubles the number of tokens: x [d, n] -> [d, 2 n]. The matrix `even` maps (x_{i - 1}, x_i) to token 2 i, and `odd`
/// maps (x_i, x_{i + 1}) to token 2 i + 1; their columns have this order. Tokens beyond the ends are zeros. Source:
/// torch.nn.ConvTranspose1d(kernel_size = 4, stride = 2, padding = 1).
class DoublingConvolution : public Module<DoublingConvolution> {
 public:
  DoublingConvolution(const Scope& s, int d)
      : Module(s), even_(s / "even", 2 * d, d, Bias::yes), odd_(s / "odd", 2 * d, d, Bias::yes) {}
  Tensor forward(Graph& g, Tensor x) const;

 private:
  Linear even_, odd_;
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
