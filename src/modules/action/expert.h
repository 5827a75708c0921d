// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <variant>
#include <vector>

#include "modules/language/decoder.h"

namespace vla {

/// An expert layer whose actions see the prefix through the language model's keys and values, and each other causally.
class ExpertSelfBlock : public Module<ExpertSelfBlock> {
 public:
  ExpertSelfBlock(const Scope& s, int d_model, int d_ff, const Heads& heads, float eps);
  /// x [d_model, horizon] -> the same shape; `prefix` is the cached layer of the language model.
  Tensor forward(Graph& g, Tensor x, const KeyValue& prefix) const;

 private:
  RmsNorm attn_norm_;
  Attention attention_;
  RmsNorm ffn_norm_;
  GatedMlp mlp_;
};

/// An expert layer whose actions see only the prefix, through keys and values projected once more.
class ExpertCrossBlock : public Module<ExpertCrossBlock> {
 public:
  ExpertCrossBlock(const Scope& s, int d_model, int d_ff, const Heads& heads, float eps);
  /// Observation rate: projects the cached layer of the language model into the cache.
  void prepare(Graph& g, const KeyValue& prefix, Cache& cache) const;
  /// Step rate. x [d_model, horizon] -> the same shape.
  Tensor forward(Graph& g, Tensor x, const Cache& cache) const;

 private:
  RmsNorm attn_norm_;
  Attention attention_;
  RmsNorm ffn_norm_;
  GatedMlp mlp_;
};

/// The action expert beside a language model: a narrower decoder whose layer i attends to what layer i of the language
/// model left in the cache. `<path>.layer_kinds` says for each of them whether the expert's layer is self or cross
/// attention, or missing. Source: lerobot policies/smolvla/smolvlm_with_expert.py.
class Expert {
 public:
  Expert(const Scope& s, const Decoder& lm);

  /// Observation rate: whatever depends on the prefix alone.
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
