// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "modules/attention.h"
#include "nn/adaptive_norm.h"
#include "nn/mlp.h"

namespace vla {

/// One layer of a diffusion transformer: attention to a context or to its own tokens after an adaptive norm, then a
/// GELU MLP after a norm without weights. Source: lerobot policies/groot/action_head/cross_attention_dit.py
/// BasicTransformerBlock (ada_norm).
class DitBlock : public Module<DitBlock> {
 public:
  /// `d_context`: width of the rows that keys and values are projected from.
  DitBlock(const Scope& s, int d_model, int d_context, int n_head, int d_ff, float eps);
  /// Projects a context [d_context, n], without normalizing it, to keys and values.
  const KeyValueProjection& project() const { return attention_.project(); }
  /// x [d_model, n], modulation [2 d_model, 1] -> the shape of x. If `seen` is empty, the tokens attend to each other.
  Tensor forward(Graph& g, Tensor x, Tensor modulation, const std::optional<KeyValue>& seen) const;

  const AdaLayerNorm& norm() const { return norm_; }

 private:
  float eps_;
  AdaLayerNorm norm_;
  Attention attention_;
  Mlp mlp_;
};

/// A diffusion transformer. Even layers attend to a context, odd layers to their own tokens. In an alternating Dit the
/// even layers take turns between the text and the images of the context. Source: the same file, DiT and
/// AlternateVLDiT.
class Dit {
 public:
  Dit(const Scope& s, int d_context, bool alternating);

  /// Load rate: embedded times [d_model, n_time] -> the modulations of all norms, concatenated: [2 d_model * (n_layer +
  /// 1), n_time].
  Tensor modulations(Graph& g, Tensor time) const;
  /// Observation rate: caches keys and values of the rows that each even layer attends to, [d_context, n] each. If
  /// layers do not alternate, `text` is the whole context.
  void prepare(Graph& g, Tensor text, Tensor image, Cache& cache) const;
  /// Step rate: x [d_model, n] -> [d_out, n]. `modulations`: one column of the function `modulations`; elements after
  /// it are ignored.
  Tensor operator()(Graph& g, Tensor x, Tensor modulations, const Cache& cache) const;

  int d_model() const { return d_model_; }
  int d_out() const { return d_out_; }
  /// Elements in a column of modulations.
  int d_modulations() const { return 2 * d_model_ * (static_cast<int>(blocks_.size()) + 1); }

 private:
  int d_model_, d_out_, text_every_n_blocks_;
  std::vector<DitBlock> blocks_;
  AdaLayerNorm out_norm_;
  Linear out_;
};

}  // namespace vla
