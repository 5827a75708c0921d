// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/action/cross_head.h"

#include <fmt/format.h>

#include "nn/attention.h"
#include "nn/tokens.h"

namespace vla {

CrossBlock::CrossBlock(const Scope& s, int d_model, int d_ff, int n_head, float eps)
    : Module(s),
      n_head_(n_head),
      attn_norm_(s / "attn_norm", d_model, eps),
      q_(s / "attn_q", d_model, d_model, Bias::yes),
      k_(s / "attn_k", d_model, d_model, Bias::yes),
      v_(s / "attn_v", d_model, d_model, Bias::yes),
      out_(s / "attn_out", d_model, d_model, Bias::yes),
      ffn_norm_(s / "ffn_norm", d_model, eps),
      mlp_(s, d_model, d_ff, Activation::gelu_erf) {}

KeyValue CrossBlock::project(Graph& g, Tensor context) const {
  const std::vector<Tensor> kv = Linear::group(g, {&k_, &v_}, context);
  return {split_heads(g, kv[0], n_head_), split_heads(g, kv[1], n_head_)};
}

Tensor CrossBlock::forward(Graph& g, Tensor x, Tensor time, const KeyValue& seen, Tensor mask) const {
  const Tensor query = split_heads(g, q_(g, attn_norm_(g, x)), n_head_);
  x = out_.added_to(g, x, attention(g, query, seen.key, seen.value, mask, seen.packed));
  return mlp_.added_to(g, x, add(g, ffn_norm_(g, x), time));
}

CrossHead::CrossHead(const Scope& s, int d_model)
    : path_(s.path()), norm_(s / "norm", d_model, s.number("norm_eps", kNormEps)) {
  const int n_layer = s.n_layer("n_layer"), n_head = s.dim("n_head", 1024), d_ff = s.dim("d_ff");
  s.require(d_model % n_head == 0, "n_head", fmt::format("a divisor of lm.d_model {}", d_model),
            std::to_string(n_head));
  for (int i = 0; i < n_layer; ++i)
    blocks_.emplace_back(s / "blk" / i, d_model, d_ff, n_head, s.number("norm_eps", kNormEps));
}

void CrossHead::keep(Graph& g, Tensor rows, Cache& cache) const {
  for (const CrossBlock& block : blocks_) block.project(g, rows).put(g, cache, block.path() + ".kept");
}

void CrossHead::prepare(Graph& g, Tensor context, std::span<const Kept> kept, int n_query, Cache& cache) const {
  std::vector<int> copies(static_cast<std::size_t>(context.dim(1)), 1);
  for (const Kept& rows : kept) copies.insert(copies.end(), static_cast<std::size_t>(rows.count), rows.copies);
  for (const CrossBlock& block : blocks_) {
    KeyValue seen = block.project(g, context);
    for (const Kept& rows : kept) {
      const KeyValue all = KeyValue::get(cache, block.path() + ".kept");
      seen = {append_keys(g, seen.key, slice_keys(g, all.key, rows.first, rows.count)),
              append_keys(g, seen.value, slice_keys(g, all.value, rows.first, rows.count))};
    }
    seen.put_packed(g, cache, block.path());
  }
  if (const Tensor mask = copies_mask(g, copies, n_query)) cache.put(g, path_ + ".mask", mask);
}

Tensor CrossHead::operator()(Graph& g, Tensor x, Tensor time, const Cache& cache) const {
  const std::string mask = path_ + ".mask";
  for (const CrossBlock& block : blocks_)
    x = block(g, x, time, KeyValue::get(cache, block.path()), cache.has(mask) ? cache.get(mask) : Tensor());
  return norm_(g, x);
}

}  // namespace vla
