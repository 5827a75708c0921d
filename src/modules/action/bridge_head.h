// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "modules/attention.h"
#include "nn/linear.h"
#include "nn/norm.h"

namespace vla {

/// The projections of a bridge attention to keys and values. original: one projection for all inputs. pro: one for each
/// kind of input, and rotary embeddings of queries and keys. Source: VLA-Adapter prismatic/models/action_heads.py
/// MLPResNetBlock, MLPResNetBlock_Pro.
enum class BridgeVersion { original, pro };

/// One layer over the rows of a chunk. The rows attend to themselves, to action features and to task features; a gate
/// multiplies the scores of the task features. Then relu(linear(norm(attention + x))).
class BridgeBlock : public Module<BridgeBlock> {
 public:
  BridgeBlock(const Scope& s, int d_model, int n_head, BridgeVersion version, float eps);
  /// Load rate: the gate, between -1 and 1.
  void constants(Graph& g, Cache& cache) const;
  /// x [d_model, horizon], actions [d_model, n_action], task [d_model, n_task] -> the shape of x.
  Tensor forward(Graph& g, Tensor x, Tensor actions, Tensor task, const Cache& cache) const;

 private:
  Tensor placed(Graph& g, Tensor heads) const;
  KeyValue seen(Graph& g, const KeyValueProjection& projection, Tensor x) const;

  int n_head_;
  BridgeVersion version_;
  Linear q_;
  KeyValueProjection rows_;
  std::optional<KeyValueProjection> actions_, task_;  // only in `pro`; `original` uses `rows_`
  const Param* gate_;
  Linear out_;
  LayerNorm norm_;
  Linear linear_;
};

/// VLA-Adapter's head: blocks over the rows of a chunk. Each block attends to the features of one layer of a language
/// model. All rows start equal. Source: VLA-Adapter prismatic/models/action_heads.py L1RegressionActionHead, MLPResNet.
class BridgeHead {
 public:
  BridgeHead(const Scope& s, int d_model, int n_layer, int d_action, int horizon);
  /// Load rate: the rows before the first block, and the gates.
  void constants(Graph& g, Cache& cache) const;
  /// The rows before the first block: [d_model, horizon].
  Tensor start(Graph& g, const Cache& cache) const { return cache.get(g, start_path_); }
  const BridgeBlock& block(int i) const { return blocks_[static_cast<std::size_t>(i)]; }
  /// Projects the rows after the last block: [d_model, horizon] -> [d_action, horizon].
  Tensor end(Graph& g, Tensor x) const { return out_(g, out_norm_(g, x)); }

 private:
  std::string start_path_;
  int d_in_, horizon_;
  LayerNorm in_norm_;
  Linear in_;
  std::vector<BridgeBlock> blocks_;
  LayerNorm out_norm_;
  Linear out_;
};

}  // namespace vla
