// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "nn/linear.h"

namespace vla {

/// Reduces the number of image tokens: each square of `<path>.factor`^2 patches becomes one token of the language
/// model's width. Source: transformers modeling_smolvlm.py SmolVLMConnector.
class PixelConnector : public Module<PixelConnector> {
 public:
  PixelConnector(const Scope& s, int d_vision, int d_model);
  /// x [d_vision, side^2, n_view] -> [d_model, (side / factor)^2, n_view]. `check` must have accepted the side.
  Tensor forward(Graph& g, Tensor x) const;
  /// Checks that a grid of `side` x `side` patches can be divided. Errors: unsupported.
  Status check(int side) const;
  /// The number of tokens for a grid of `side` x `side` patches.
  int n_token(int side) const { return (side / factor_) * (side / factor_); }

 private:
  int factor_;
  Linear project_;
};

}  // namespace vla
