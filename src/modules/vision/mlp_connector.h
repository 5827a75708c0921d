// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "nn/mlp.h"
#include "nn/norm.h"

namespace vla {

/// Fewer, wider image tokens through a norm and an MLP: squares of `<path>.factor`^2 patches become one token of the
/// language model's width. Source: InternVL internvl_chat/internvl/model/internvl_chat/modeling_internvl_chat.py
/// extract_feature.
class MlpConnector : public Module<MlpConnector> {
 public:
  /// `n_side`: patches in a row of a view.
  MlpConnector(const Scope& s, int d_vision, int d_model, int n_side);
  /// x [d_vision, n_side^2, n_view] -> [d_model, n_token(), n_view].
  Tensor forward(Graph& g, Tensor x) const;
  /// Tokens of a view.
  int n_token() const { return n_token_; }

 private:
  int factor_, n_token_;
  LayerNorm norm_;
  Linear up_, down_;
};

}  // namespace vla
