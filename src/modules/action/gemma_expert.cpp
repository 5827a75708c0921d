// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/action/gemma_expert.h"

#include <fmt/format.h>

#include "nn/tokens.h"

namespace vla {
namespace {

std::variant<RmsNorm, AdaRmsNorm> make_norm(const Scope& s, ExpertNorm kind, int d, float eps) {
  if (kind == ExpertNorm::weighted) return RmsNorm(s, d, eps);
  return AdaRmsNorm(s, d, d, eps);
}

Tensor residual(Graph& g, Tensor x, Tensor y, Tensor gate) { return gate ? gated_add(g, x, y, gate) : add(g, x, y); }

}  // namespace

TimedNorm::TimedNorm(const Scope& s, ExpertNorm kind, int d, float eps) : norm_(make_norm(s, kind, d, eps)) {}

TimedNorm::Result TimedNorm::operator()(Graph& g, Tensor x, Tensor modulation) const {
  if (const auto* weighted = std::get_if<RmsNorm>(&norm_)) return {(*weighted)(g, x), {}};
  const AdaRmsNorm& adaptive = std::get<AdaRmsNorm>(norm_);
  return {adaptive(g, x, modulation), adaptive.gate(g, modulation)};
}

GemmaExpertBlock::GemmaExpertBlock(const Scope& s, ExpertNorm kind, int d_model, int d_ff, const Heads& heads,
                                   float eps)
    : Module(s),
      attn_norm_(s / "attn_norm", kind, d_model, eps),
      attention_(s, d_model, d_model, heads),
      ffn_norm_(s / "ffn_norm", kind, d_model, eps),
      mlp_(s, d_model, d_ff, Activation::gelu_tanh) {}

Tensor GemmaExpertBlock::rest(Graph& g, Tensor x, const TimedNorm::Result& normed, Tensor rotary,
                              const std::vector<KeyValue>& segments, Tensor ffn) const {
  x = residual(g, x, attention_(g, normed.h, rotary, segments), normed.gate);
  const auto [h, gate] = ffn_norm_(g, x, ffn);
  return residual(g, x, mlp_(g, h), gate);
}

Tensor GemmaExpertBlock::forward(Graph& g, Tensor x, const KeyValue& past, const Modulations& modulations) const {
  const TimedNorm::Result normed = attn_norm_(g, x, modulations.attn);
  const Tensor turned = rotary(g, x, past);
  return rest(g, x, normed, turned, {past, attention_.project()(g, normed.h, turned)}, modulations.ffn);
}

Tensor GemmaExpertBlock::prefill(Graph& g, Tensor x, const KeyValue& past, Cache& cache) const {
  const TimedNorm::Result normed = attn_norm_(g, x, {});
  const Tensor turned = rotary(g, x, past);
  const KeyValue own = attention_.project()(g, normed.h, turned);
  const KeyValue seen = {concat(g, {past.key, own.key}, 2), concat(g, {past.value, own.value}, 2)};
  put(g, cache, path(), seen);
  return rest(g, x, normed, turned, {seen}, {});
}

GemmaExpert::GemmaExpert(const Scope& s, const Decoder& lm, ExpertNorm kind)
    : lm_(lm), d_model_(s.dim("d_model")), norm_(s / "norm", kind, d_model_, s.number("norm_eps", kNormEps)) {
  const int n_layer = s.n_layer("n_layer"), d_ff = s.dim("d_ff");
  s.require(n_layer == lm.n_layer(), "n_layer", fmt::format("{}, as lm.n_layer", lm.n_layer()),
            std::to_string(n_layer));
  Heads heads = lm.heads();
  heads.rope_base = s.number("rope_base", kRopeBase);
  for (int i = 0; i < lm.n_layer(); ++i)
    blocks_.emplace_back(s / "blk" / i, kind, d_model_, d_ff, heads, s.number("norm_eps", kNormEps));
}

KeyValue GemmaExpert::past(Graph& g, const Cache& cache, std::size_t i) const {
  if (cache.has(blocks_[i].path() + ".k")) return get(g, cache, blocks_[i].path());
  return lm_.cached(g, cache, static_cast<int>(i));
}

std::vector<const TimedNorm*> GemmaExpert::norms() const {
  std::vector<const TimedNorm*> all;
  for (const GemmaExpertBlock& block : blocks_) all.insert(all.end(), {&block.attn_norm(), &block.ffn_norm()});
  all.push_back(&norm_);
  return all;
}

Tensor GemmaExpert::modulations(Graph& g, Tensor time) const {
  Tensor all;
  for (const TimedNorm* norm : norms()) {
    const Tensor one = norm->modulation(g, time);
    all = all ? concat_features(g, all, one) : one;
  }
  return all;
}

Tensor GemmaExpert::part(Graph& g, Tensor modulations, std::size_t i_norm) const {
  if (!modulations) return {};
  return slice_features(g, modulations, static_cast<int>(i_norm) * 3 * d_model_, 3 * d_model_);
}

void GemmaExpert::prefill(Graph& g, Tensor x, Cache& cache) const {
  // Of the last layer only keys and values are read, so the graph does not compute the rest of that layer.
  for (std::size_t i = 0; i < blocks_.size(); ++i) x = blocks_[i].prefill(g, x, past(g, cache, i), cache);
}

Tensor GemmaExpert::operator()(Graph& g, Tensor x, Tensor modulations, const Cache& cache) const {
  for (std::size_t i = 0; i < blocks_.size(); ++i)
    x = blocks_[i](g, x, past(g, cache, i),
                   GemmaExpertBlock::Modulations{part(g, modulations, 2 * i), part(g, modulations, 2 * i + 1)});
  return norm_(g, x, part(g, modulations, 2 * blocks_.size())).h;
}

std::map<std::string, Value, std::less<>> GemmaExpert::published(std::map<std::string, Value, std::less<>> policy) {
  policy.insert({{"expert.d_model", 1024},
                 {"expert.n_layer", 18},
                 {"expert.d_ff", 4096},
                 {"expert.norm_eps", 1e-6},
                 {"expert.rope_base", 10000.0}});
  return policy;
}

}  // namespace vla
