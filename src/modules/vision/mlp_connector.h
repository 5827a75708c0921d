// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "nn/mlp.h"
#include "nn/norm.h"

namespace vla {

/// Reduces the number of image tokens with a norm and an MLP: each square of `<path>.factor`^2 patches becomes one
/// token of the language model's width. Source: InternVL
/// internvl_chat/internvl/model/internvl_chat/modeling_internvl_chat.py extract_feature; Isaac-GR00T
/// Eagle-Block2A-2B-v2 modeling_eagle3_vl.py (whose features the converter reorders).
class MlpConnector : public Module<MlpConnector> {
 public:
  /// `n_row` x `n_column`: patches of a view.
  MlpConnector(const Scope& s, int d_vision, int d_model, int n_row, int n_column);
  /// x [d_vision, n_row * n_column, n_view] -> [d_model, n_token(), n_view].
  Tensor forward(Graph& g, Tensor x) const;
  /// Tokens of a view.
  int n_token() const { return n_token_; }

 private:
  int factor_, n_column_, n_token_;
  LayerNorm norm_;
  Linear up_, down_;
};

}  // namespace vla
