// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "modules/attention.h"
#include "nn/adaptive_norm.h"
#include "nn/mlp.h"

namespace vla {

/// One layer of a diffusion transformer: attention to a context or among its own tokens, behind a norm that the time
/// modulates, then a GELU MLP behind a norm without weights.
/// Source: lerobot policies/groot/action_head/cross_attention_dit.py BasicTransformerBlock (ada_norm).
class DitBlock : public Module<DitBlock> {
 public:
  /// `d_context`: width of what keys and values are made from.
  DitBlock(const Scope& s, int d_model, int d_context, int n_head, int d_ff, float eps);
  /// Makes keys and values of a context [d_context, n], which is not normalized.
  const KeyValueProjection& project() const { return attention_.project(); }
  /// x [d_model, n], modulation [2 d_model, 1] -> the shape of x. Where `seen` is empty the tokens see each other.
  Tensor forward(Graph& g, Tensor x, Tensor modulation, const std::optional<KeyValue>& seen) const;

  const AdaLayerNorm& norm() const { return norm_; }

 private:
  float eps_;
  AdaLayerNorm norm_;
  Attention attention_;
  Mlp mlp_;
};

/// A diffusion transformer whose even layers look at a context and whose odd layers look at their own tokens. An
/// alternating one looks in turn at the text and at the images of its context. Source: the same file, DiT and
/// AlternateVLDiT.
class Dit {
 public:
  Dit(const Scope& s, int d_context, bool alternating);

  /// Load rate: the embedded times [d_model, n_time] -> the modulations of all norms one above the other, [2 d_model *
  /// (n_layer + 1), n_time].
  Tensor modulations(Graph& g, Tensor time) const;
  /// Observation rate: keys and values of every even layer, of the rows that it looks at, [d_context, n] each. Where
  /// layers do not alternate, `text` is the whole context.
  void prepare(Graph& g, Tensor text, Tensor image, Cache& cache) const;
  /// Step rate: x [d_model, n] -> [d_out, n]. `modulations` begins with one column of the above.
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
