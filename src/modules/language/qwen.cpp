// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/language/qwen.h"

#include <numeric>

#include "nn/attention.h"
#include "nn/tokens.h"

namespace vla {
QwenBlock::QwenBlock(const Scope& s, QwenFamily family, int d_model, int d_ff, const Heads& heads, float eps)
    : Module(s),
      heads_(heads),
      attn_norm_(s / "attn_norm", d_model, eps),
      q_(s / "attn_q", d_model, heads.d_query(), family.bias),
      k_(s / "attn_k", d_model, heads.d_key(), family.bias),
      v_(s / "attn_v", d_model, heads.d_key(), family.bias),
      out_(s / "attn_out", heads.d_query(), d_model, Bias::no),
      ffn_norm_(s / "ffn_norm", d_model, eps),
      mlp_(s, d_model, d_ff, Activation::silu) {
  if (!family.head_norms) return;
  q_norm_.emplace(s / "attn_q_norm", heads.d_head, eps);
  k_norm_.emplace(s / "attn_k_norm", heads.d_head, eps);
}

Tensor QwenBlock::forward(Graph& g, Tensor x, Tensor rotary, Tensor mask, Tensor added) const {
  const std::vector<Tensor> qkv = Linear::group(g, {&q_, &k_, &v_}, attn_norm_(g, x));
  const auto turned = [&](Tensor part, int n_head, const std::optional<RmsNorm>& norm) {
    part = split_heads(g, part, n_head);
    return rope(g, norm ? (*norm)(g, part) : part, rotary);
  };
  const Tensor mixed = attention(g, turned(qkv[0], heads_.n_head, q_norm_), turned(qkv[1], heads_.n_head_kv, k_norm_),
                                 split_heads(g, qkv[2], heads_.n_head_kv), mask);
  x = out_.added_to(g, x, mixed);
  return mlp_.added_to(g, added ? add(g, x, added) : x, ffn_norm_(g, x));
}

Tensor QwenBlock::alone(Graph& g, Tensor x) const { return mlp_.added_to(g, x, ffn_norm_(g, x)); }

Qwen::Qwen(const Scope& s, QwenFamily family)
    : d_model_(s.dim("d_model")),
      heads_(Heads::read(s, RotaryAngle::product)),
      token_embd_(s / "token_embd", d_model_, s.dim("n_vocab", 1 << 24)) {
  const int n_layer = s.n_layer("n_layer"), d_ff = s.dim("d_ff");
  const float eps = s.number("norm_eps", kNormEps);
  for (int i = 0; i < n_layer; ++i) blocks_.emplace_back(s / "blk" / i, family, d_model_, d_ff, heads_, eps);
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

Tensor Qwen::operator()(Graph& g, Tensor x, std::span<const int> positions, Tensor mask) const {
  return (*this)(g, x, rotary_table(g, heads_.d_head, heads_.rope_base, heads_.rope_angle, positions), mask, {});
}

Tensor Qwen::operator()(Graph& g, Tensor x, Tensor rotary, Tensor mask, const std::vector<Tensor>& added) const {
  for (std::size_t i = 0; i < blocks_.size(); ++i)
    x = blocks_[i](g, x, rotary, mask, i < added.size() ? added[i] : Tensor());
  return norm_ ? (*norm_)(g, x) : x;
}

Tensor Qwen::alone(Graph& g, Tensor x) const {
  for (const QwenBlock& block : blocks_) x = block.alone(g, x);
  return norm_ ? norm_->forward(g, x) : x;
}

}  // namespace vla
