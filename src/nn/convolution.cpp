// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/convolution.h"

#include "nn/embedding.h"

namespace vla {

Tensor pixels_first(Graph& g, Tensor images) {
  const Shape& s = images.shape();
  return g.add(op::Reshape{}, {patches(g, images, 1)}, {s[2], s[0], s[1], s[3]});
}

Convolution::Convolution(const Scope& s, int d_in, int d_out, int size, int stride)
    : Module(s), window_{size, stride, size / 2}, product_(s, size * size * d_in, d_out, Bias::yes) {}

Tensor Convolution::forward(Graph& g, Tensor x) const {
  const bool is_product = window_.size == 1 && window_.stride == 1;
  return product_.forward(g, is_product ? x : g.add(op::Unfold{window_}, {x}));
}

Tensor max_pool(Graph& g, Tensor x, int size, int stride) { return g.add(op::MaxPool{{size, stride, size / 2}}, {x}); }

}  // namespace vla
