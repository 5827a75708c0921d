// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <string>
#include <variant>
#include <vector>

#include "modules/language/decoder.h"
#include "nn/adaptive_norm.h"

namespace vla {

/// The source of the factors of the expert's norms: weights (π0) or the time (π0.5).
enum class ExpertNorm { weighted, adaptive };

/// One norm of the expert, of either kind. Source: lerobot policies/pi_gemma.py PiGemmaRMSNorm.
class TimedNorm {
 public:
  TimedNorm(const Scope& s, ExpertNorm kind, int d, float eps);

  /// The normalized x, and the gate of the residual that follows; no gate without modulation.
  struct Result {
    Tensor h, gate;
  };
  /// x [d, n], modulation [3 d, 1] or none.
  Result operator()(Graph& g, Tensor x, Tensor modulation) const;
  /// Load rate, for adaptive norms: [d, n_time] -> [3 d, n_time].
  Tensor modulation(Graph& g, Tensor time) const { return std::get<AdaRmsNorm>(norm_).modulation(g, time); }

 private:
  std::variant<RmsNorm, AdaRmsNorm> norm_;
};

/// One layer of the expert. Its tokens attend to the past and, in both directions, to each other.
class GemmaExpertBlock : public Module<GemmaExpertBlock> {
 public:
  GemmaExpertBlock(const Scope& s, ExpertNorm kind, int d_model, int d_ff, const Heads& heads, float eps);
  /// Modulations of the two norms, each [3 d_model, 1], or none.
  struct Modulations {
    Tensor attn, ffn;
  };
  /// x [d_model, n] -> the same shape; `past` holds the tokens before it.
  Tensor forward(Graph& g, Tensor x, const KeyValue& past, const Modulations& modulations) const;
  /// The same for tokens that extend the past: caches the past's keys and values followed by those of x. Takes no
  /// modulation.
  Tensor prefill(Graph& g, Tensor x, const KeyValue& past, Cache& cache) const;

  const TimedNorm& attn_norm() const { return attn_norm_; }
  const TimedNorm& ffn_norm() const { return ffn_norm_; }

 private:
  /// Attends from the normalized x, rotated by the table, to `segments`, then runs the rest of the layer.
  Tensor rest(Graph& g, Tensor x, const TimedNorm::Result& normed, Tensor rotary, const std::vector<KeyValue>& segments,
              Tensor ffn) const;
  /// The rotary table of tokens x that follow the past.
  Tensor rotary(Graph& g, Tensor x, const KeyValue& past) const {
    return attention_.heads().rotary(g, static_cast<int>(past.key.dim(2)), static_cast<int>(x.dim(1)));
  }

  TimedNorm attn_norm_;
  Attention attention_;
  TimedNorm ffn_norm_;
  GatedMlp mlp_;
};

/// The action expert of the π family: a narrower Gemma with the language model's number of layers and heads. Layer i
/// attends to the cached layer i. Source: lerobot policies/pi0/modeling_pi0.py PaliGemmaWithExpertModel.
class GemmaExpert {
 public:
  GemmaExpert(const Scope& s, const Decoder& lm, ExpertNorm kind);

  /// Load rate, for adaptive norms: embedded times [d_model, n_time] -> the modulations of all norms, concatenated: [3
  /// d_model * (2 n_layer + 1), n_time].
  Tensor modulations(Graph& g, Tensor time) const;
  /// Observation rate: appends tokens that do not see the actions to the prefix. x [d_model, n] -> cache
  /// `<path>.blk.<i>.{k,v}`: the prefix's keys and values followed by those of x.
  void prefill(Graph& g, Tensor x, Cache& cache) const;
  /// Step rate. x [d_model, horizon] -> the same shape, after the final norm. `modulations` is one column of
  /// `condition`, or none.
  Tensor operator()(Graph& g, Tensor x, Tensor modulations, const Cache& cache) const;

  int d_model() const { return d_model_; }

  /// The keys of the published size, Gemma 300M, added to a policy's own. Source: lerobot get_gemma_config.
  static std::map<std::string, Value, std::less<>> published(std::map<std::string, Value, std::less<>> policy);

 private:
  /// The norms in the order of their modulations: attention and MLP of every layer, then the final norm.
  std::vector<const TimedNorm*> norms() const;
  /// The keys and values that layer i attends to: the prefix, and the tokens of `prefill` if any.
  KeyValue past(Graph& g, const Cache& cache, std::size_t i) const;
  /// The modulation of norm `i_norm` in a column; none for norms with weights.
  Tensor part(Graph& g, Tensor modulations, std::size_t i_norm) const;

  const Decoder& lm_;
  int d_model_;
  std::vector<GemmaExpertBlock> blocks_;
  TimedNorm norm_;
};

}  // namespace vla
