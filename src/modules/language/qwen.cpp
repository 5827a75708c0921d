// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/language/qwen.h"

#include <numeric>

#include "nn/tokens.h"

namespace vla {
namespace {

Heads heads_of(const Scope& s, QwenFamily family) {
  Heads heads = Heads::read(s, RotaryAngle::product);
  heads.bias = family.bias;
  heads.rule = family.rule;
  if (family.head_norms) heads.norm_eps = s.number("norm_eps", kNormEps);
  if (family.sub_norms) heads.sub_norm_eps = s.number("norm_eps", kNormEps);
  return heads;
}

}  // namespace

QwenBlock::QwenBlock(const Scope& s, int d_model, int d_ff, const Heads& heads, float eps, Activation activation)
    : Module(s),
      attn_norm_(s / "attn_norm", d_model, eps),
      attention_(s, d_model, d_model, heads),
      ffn_norm_(s / "ffn_norm", d_model, eps),
      mlp_(s, d_model, d_ff, activation, heads.rule, heads.sub_norm_eps) {}

Tensor QwenBlock::forward(Graph& g, Tensor x, Tensor rotary, Tensor mask, Tensor added) const {
  x = add(g, x, attention_.among(g, attn_norm_(g, x), rotary, mask));
  const Tensor y = mlp_(g, ffn_norm_(g, x));
  return add(g, added ? add(g, x, added) : x, y);
}

Tensor QwenBlock::alone(Graph& g, Tensor x) const { return add(g, x, mlp_(g, ffn_norm_(g, x))); }

Qwen::Qwen(const Scope& s, QwenFamily family)
    : d_model_(s.dim("d_model")),
      heads_(heads_of(s, family)),
      token_embd_(s / "token_embd", d_model_, s.dim("n_vocab", 1 << 24)) {
  const int n_layer = s.n_layer("n_layer"), d_ff = s.dim("d_ff");
  const float eps = s.number("norm_eps", kNormEps);
  for (int i = 0; i < n_layer; ++i) blocks_.emplace_back(s / "blk" / i, d_model_, d_ff, heads_, eps, family.activation);
  if (family.final_norm) norm_.emplace(s / "norm", d_model_, eps);
}

Tensor Qwen::embed(Graph& g, Tensor tokens, Tensor views, const ViewPlaces& places) const {
  return places.arrange(g, views, static_cast<int>(tokens.dim(0)), [&](const PromptPiece& piece) {
    return embed(g, slice_ids(g, tokens, piece.first, piece.count));
  });
}

Tensor Qwen::operator()(Graph& g, Tensor x) const {
  std::vector<int> positions(static_cast<std::size_t>(x.dim(1)));
  std::iota(positions.begin(), positions.end(), 0);
  return (*this)(g, x, positions, causal_mask(g, 0, static_cast<int>(positions.size())));
}

void Qwen::layers(Graph& g, Tensor x, const std::function<void(int, Tensor)>& each) const {
  const int n = static_cast<int>(x.dim(1));
  const Tensor rotary = heads_.rotary(g, 0, n), mask = causal_mask(g, 0, n);
  for (int i = 0; i < n_layer(); ++i) {
    x = blocks_[static_cast<std::size_t>(i)](g, x, rotary, mask);
    each(i, norm_ && i + 1 == n_layer() ? (*norm_)(g, x) : x);
  }
}

Tensor Qwen::operator()(Graph& g, Tensor x, std::span<const int> positions, Tensor mask) const {
  return (*this)(g, x, rotary_table(g, heads_.d_head, heads_.rope_base, heads_.rope_angle, positions), mask, {});
}

Tensor Qwen::operator()(Graph& g, Tensor x, Tensor rotary, Tensor mask, const std::vector<Tensor>& added) const {
  for (std::size_t i = 0; i < blocks_.size(); ++i)
    x = blocks_[i](g, x, rotary, mask, i < added.size() ? added[i] : Tensor());
  return norm_ ? (*norm_)(g, x) : x;
}

Tensor Qwen::bidirectional(Graph& g, Tensor x) const {
  return (*this)(g, x, heads_.rotary(g, 0, static_cast<int>(x.dim(1))), {}, {});
}

Tensor Qwen::alone(Graph& g, Tensor x) const {
  for (const QwenBlock& block : blocks_) x = block.alone(g, x);
  return norm_ ? norm_->forward(g, x) : x;
}

}  // namespace vla
