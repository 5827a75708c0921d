// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "nn/linear.h"
#include "nn/norm.h"

namespace vla {

/// Merges consecutive patches into one token of the language model's width, through a norm and a GELU MLP. Source:
/// transformers modeling_qwen3_vl.py Qwen3VLVisionPatchMerger.
class PatchMerger : public Module<PatchMerger> {
 public:
  /// Merges `count` patches of width `d_vision`. The norm is applied to each patch or to the merged token.
  enum class Norm { patch, token };
  PatchMerger(const Scope& s, Norm norm, int d_vision, int count, int d_model, float eps);
  /// x [d_vision, n, n_view] -> [d_model, n / count, n_view].
  Tensor forward(Graph& g, Tensor x) const;

 private:
  Norm kind_;
  int d_token_;
  LayerNorm norm_;
  Linear up_, down_;
};

}  // namespace vla
