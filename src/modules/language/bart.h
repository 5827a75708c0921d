// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "modules/detr.h"
#include "nn/embedding.h"

namespace vla {

/// BART's encoder over embedded tokens: full self-attention, post-norm, learned positions. Source: transformers
/// modeling_bart.py BartEncoder.
class BartEncoder {
 public:
  explicit BartEncoder(const Scope& s);

  const Embedding& token() const { return token_; }
  /// x [d_model, n] -> the same shape, at positions 0 to n - 1.
  Tensor operator()(Graph& g, Tensor x) const { return (*this)(g, x, arange(g, static_cast<int>(x.dim(1))), {}); }
  /// The same at positions [n] i32; mask [n, n] or none.
  Tensor operator()(Graph& g, Tensor x, Tensor positions, Tensor mask) const;
  /// Errors: bad_bundle for more tokens than positions.
  Status check(int n_token) const;

  int d_model() const { return family_.d_model; }
  int n_position() const { return n_position_; }

 private:
  DetrFamily family_;
  int n_position_;
  Embedding token_, position_;
  LayerNorm norm_;
  std::vector<DetrEncoderLayer> layers_;
};

}  // namespace vla
