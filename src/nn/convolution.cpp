// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/convolution.h"

#include "nn/embedding.h"
#include "nn/tokens.h"

namespace vla {

Tensor pixels_first(Graph& g, Tensor images) {
  const Shape& s = images.shape();
  return g.add(op::Reshape{}, {patches(g, images, 1)}, {s[2], s[0], s[1], s[3]});
}

Convolution::Convolution(const Scope& s, int d_in, int d_out, int size, int stride, Bias bias)
    : Module(s), window_{size, stride, size / 2}, product_(s, size * size * d_in, d_out, bias) {}

Tensor Convolution::forward(Graph& g, Tensor x) const {
  const bool is_product = window_.size == 1 && window_.stride == 1;
  return product_.forward(g, is_product ? x : g.add(op::Unfold{window_}, {x}));
}

namespace {

/// Adds `count` zero tokens before and after x.
Tensor padded(Graph& g, Tensor x, int count) {
  if (count == 0) return x;
  const Tensor zeros = full(g, 0, x.dim(0), count);
  return concat_tokens(g, {zeros, x, zeros});
}

/// Concatenates the tokens in a window of `size` tokens, for each place of the window: [d, n] -> [size * d, n - size +
/// 1].
Tensor windows(Graph& g, Tensor x, int size) {
  const int n_place = static_cast<int>(x.dim(1)) - size + 1;
  std::vector<Tensor> parts;
  for (int i = 0; i < size; ++i) parts.push_back(slice_tokens(g, x, i, n_place));
  return concat(g, parts, 0);
}

}  // namespace

Tensor TokenConvolution::forward(Graph& g, Tensor x) const {
  return product_.forward(g, windows(g, padded(g, x, size_ / 2), size_));
}

/// Place i of the window covers the padded tokens p_2i, p_2i+1 and p_2i+2: a pair, and the first of the next pair.
Tensor HalvingConvolution::forward(Graph& g, Tensor x) const {
  const std::int64_t d = x.dim(0);
  const int n = static_cast<int>(x.dim(1)) / 2;
  const Tensor pairs = reshape_width(g, padded(g, x, 1), 2 * d);
  const Tensor next = slice_features(g, slice_tokens(g, pairs, 1, n), 0, static_cast<int>(d));
  return product_.forward(g, concat_features(g, slice_tokens(g, pairs, 0, n), next));
}

Tensor DoublingConvolution::forward(Graph& g, Tensor x) const {
  const int n = static_cast<int>(x.dim(1));
  const Tensor pairs = windows(g, padded(g, x, 1), 2);  // [2 d, n + 1]
  const Tensor even = even_.forward(g, slice_tokens(g, pairs, 0, n)),
               odd = odd_.forward(g, slice_tokens(g, pairs, 1, n));
  return reshape_width(g, concat_features(g, even, odd), x.dim(0));
}

Tensor max_pool(Graph& g, Tensor x, int size, int stride) { return g.add(op::MaxPool{{size, stride, size / 2}}, {x}); }

}  // namespace vla
