// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/action/dit.h"

#include <fmt/format.h>

#include "nn/tokens.h"

namespace vla {

DitBlock::DitBlock(const Scope& s, int d_model, int d_context, int n_head, int d_ff, float eps)
    : Module(s),
      eps_(eps),
      norm_(s / "ada", d_model, eps, AdaLayerNorm::Order::scale_shift),
      attention_(s, d_model, d_context, Heads::even(d_model, n_head)),
      mlp_(s, d_model, d_ff, Activation::gelu_tanh) {}

Tensor DitBlock::forward(Graph& g, Tensor x, Tensor modulation, const std::optional<KeyValue>& seen) const {
  const Tensor h = norm_.forward(g, x, modulation);
  x = add(g, x, seen ? attention_(g, h, {}, {*seen}) : attention_.among(g, h, {}));
  return add(g, x, mlp_(g, layer_norm(g, x, eps_)));
}

Dit::Dit(const Scope& s, int d_context, bool alternating)
    : d_model_(s.dim("d_model")),
      d_out_(s.dim("d_out")),
      text_every_n_blocks_(alternating ? s.dim("attend_text_every_n_blocks", 512) : 1),
      out_norm_(s / "out_ada", d_model_, s.number("out_eps", kNormEps), AdaLayerNorm::Order::shift_scale),
      out_(s / "out", d_model_, d_out_, Bias::yes) {
  const int n_layer = s.n_layer("n_layer"), n_head = s.dim("n_head", 1024), d_ff = s.dim("d_ff");
  s.require(d_model_ % n_head == 0, "n_head", fmt::format("a divisor of d_model {}", d_model_), std::to_string(n_head));
  for (int i = 0; i < n_layer; ++i)
    blocks_.emplace_back(s / "blk" / i, d_model_, i % 2 == 0 ? d_context : d_model_, n_head, d_ff,
                         s.number("norm_eps", kNormEps));
}

Tensor Dit::modulations(Graph& g, Tensor time) const {
  Tensor all;
  for (const DitBlock& block : blocks_) {
    const Tensor one = block.norm().modulation(g, time);
    all = all ? concat_features(g, all, one) : one;
  }
  return concat_features(g, all, out_norm_.modulation(g, time));
}

void Dit::prepare(Graph& g, Tensor text, Tensor image, Cache& cache) const {
  for (std::size_t i = 0; i < blocks_.size(); i += 2) {
    const bool of_text = static_cast<int>(i) % (2 * text_every_n_blocks_) == 0;
    put(g, cache, blocks_[i].path(), blocks_[i].project()(g, of_text ? text : image));
  }
}

Tensor Dit::operator()(Graph& g, Tensor x, Tensor modulations, const Cache& cache) const {
  const auto part = [&](std::size_t i) {
    return slice_features(g, modulations, static_cast<int>(i) * 2 * d_model_, 2 * d_model_);
  };
  for (std::size_t i = 0; i < blocks_.size(); ++i)
    x = blocks_[i](g, x, part(i), i % 2 == 0 ? std::optional(get(g, cache, blocks_[i].path())) : std::nullopt);
  return out_(g, out_norm_.forward(g, x, part(blocks_.size())));
}

}  // namespace vla
