// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/language/qwen.h"

#include "nn/attention.h"
#include "nn/tokens.h"

namespace vla {

QwenBlock::QwenBlock(const Scope& s, int d_model, int d_ff, const Heads& heads, float eps)
    : Module(s),
      heads_(heads),
      attn_norm_(s / "attn_norm", d_model, eps),
      q_(s / "attn_q", d_model, heads.d_query(), Bias::yes),
      k_(s / "attn_k", d_model, heads.d_key(), Bias::yes),
      v_(s / "attn_v", d_model, heads.d_key(), Bias::yes),
      out_(s / "attn_out", heads.d_query(), d_model, Bias::no),
      ffn_norm_(s / "ffn_norm", d_model, eps),
      mlp_(s, d_model, d_ff, Activation::silu) {}

Tensor QwenBlock::forward(Graph& g, Tensor x, std::span<const int> positions, Tensor mask) const {
  const std::vector<Tensor> qkv = Linear::group(g, {&q_, &k_, &v_}, attn_norm_(g, x));
  const auto turned = [&](Tensor part, int n_head) {
    return rope(g, split_heads(g, part, n_head), heads_.rope_base, heads_.rope_angle, positions);
  };
  const Tensor mixed = attention(g, turned(qkv[0], heads_.n_head), turned(qkv[1], heads_.n_head_kv),
                                 split_heads(g, qkv[2], heads_.n_head_kv), mask);
  return alone(g, out_.added_to(g, x, mixed));
}

Tensor QwenBlock::alone(Graph& g, Tensor x) const { return mlp_.added_to(g, x, ffn_norm_(g, x)); }

Qwen::Qwen(const Scope& s)
    : d_model_(s.dim("d_model")),
      heads_(Heads::read(s, RotaryAngle::product)),
      token_embd_(s / "token_embd", d_model_, s.dim("n_vocab", 1 << 24)),
      norm_(s / "norm", d_model_, s.number("norm_eps")) {
  const int n_layer = s.n_layer("n_layer"), d_ff = s.dim("d_ff");
  for (int i = 0; i < n_layer; ++i) blocks_.emplace_back(s / "blk" / i, d_model_, d_ff, heads_, s.number("norm_eps"));
}

Tensor Qwen::operator()(Graph& g, Tensor x, std::span<const int> positions, Tensor mask) const {
  for (const QwenBlock& block : blocks_) x = block(g, x, positions, mask);
  return norm_(g, x);
}

Tensor Qwen::alone(Graph& g, Tensor x) const {
  for (const QwenBlock& block : blocks_) x = block.alone(g, x);
  return norm_.forward(g, x);
}

}  // namespace vla
