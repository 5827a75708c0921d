// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <string>
#include <vector>

#include "modules/attention.h"
#include "nn/mlp.h"
#include "nn/norm.h"

namespace vla {

/// One layer over action tokens: cross-attention to the context, which is the same in every step, then a GELU MLP whose
/// input has the time added. Tokens do not attend to each other. Source: Evo-1 Evo_1/model/action_head/flow_matching.py
/// BasicTransformerBlock.
class CrossBlock : public Module<CrossBlock> {
 public:
  CrossBlock(const Scope& s, int d_model, int d_ff, int n_head, float eps);
  /// Projects a context [d_model, n], without normalizing it, to keys and values.
  const KeyValueProjection& project() const { return attention_.project(); }
  /// x [d_model, n], time [d_model, 1], mask [n_key, n] or none -> the shape of x.
  Tensor forward(Graph& g, Tensor x, Tensor time, const KeyValue& seen, Tensor mask) const;

 private:
  LayerNorm attn_norm_;
  Attention attention_;
  LayerNorm ffn_norm_;
  Mlp mlp_;
};

/// A stack of cross layers and a final norm.
class CrossHead {
 public:
  CrossHead(const Scope& s, int d_model);

  /// Load rate: keeps the keys and values of rows that any observation may need.
  void keep(Graph& g, Tensor rows, Cache& cache) const;
  /// `count` of the rows passed to `keep`, starting at `first`, each repeated `copies` times.
  struct Kept {
    int first, count, copies;
  };
  /// Observation rate: caches keys and values of the context [d_model, n], followed by kept rows.
  void prepare(Graph& g, Tensor context, std::span<const Kept> kept, int n_query, Cache& cache) const;
  /// Step rate: x [d_model, n_query] -> the same shape, normalized.
  Tensor operator()(Graph& g, Tensor x, Tensor time, const Cache& cache) const;

 private:
  std::string path_;
  LayerNorm norm_;
  std::vector<CrossBlock> blocks_;
};

}  // namespace vla
