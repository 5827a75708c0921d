// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <variant>
#include <vector>

#include "modules/language/decoder.h"

namespace vla {

/// An expert layer with self-attention: actions attend to the language model's cached keys and values, and causally to
/// each other.
class ExpertSelfBlock : public Module<ExpertSelfBlock> {
 public:
  ExpertSelfBlock(const Scope& s, int d_model, int d_ff, const Heads& heads, float eps);
  /// x [d_model, horizon] -> the same shape; `prefix`: keys and values of the language model's layer.
  Tensor forward(Graph& g, Tensor x, const KeyValue& prefix) const;

 private:
  RmsNorm attn_norm_;
  Attention attention_;
  RmsNorm ffn_norm_;
  GatedMlp mlp_;
};

/// An expert layer with cross-attention: actions attend to the prefix only, through keys and values that this layer
/// projects again.
class ExpertCrossBlock : public Module<ExpertCrossBlock> {
 public:
  ExpertCrossBlock(const Scope& s, int d_model, int d_ff, const Heads& heads, float eps);
  /// Observation rate: projects keys and values of the language model's layer and caches the result.
  void prepare(Graph& g, const KeyValue& prefix, Cache& cache) const;
  /// Step rate. x [d_model, horizon] -> the same shape.
  Tensor forward(Graph& g, Tensor x, const Cache& cache) const;

 private:
  RmsNorm attn_norm_;
  Attention attention_;
  RmsNorm ffn_norm_;
  GatedMlp mlp_;
};

/// SmolVLA's action expert: a narrower decoder whose layer i attends to the cached layer i of the language model.
/// `<path>.layer_kinds` states for each of the language model's layers whether the expert's layer has self-attention or
/// cross-attention, or does not exist. Source: lerobot policies/smolvla/smolvlm_with_expert.py.
class Expert {
 public:
  Expert(const Scope& s, const Decoder& lm);

  /// Observation rate: computes the values that depend only on the prefix.
  void prepare(Graph& g, Cache& cache) const;
  /// Step rate. x [d_model, horizon] -> the same shape, after the final norm.
  Tensor operator()(Graph& g, Tensor x, const Cache& cache) const;

  int d_model() const { return d_model_; }

 private:
  struct Layer {
    int i_lm;
    std::variant<ExpertSelfBlock, ExpertCrossBlock> block;
  };

  const Decoder& lm_;
  int d_model_;
  std::vector<Layer> layers_;
  RmsNorm norm_;
};

}  // namespace vla
