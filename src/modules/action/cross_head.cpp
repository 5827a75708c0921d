// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/action/cross_head.h"

#include <fmt/format.h>

#include "nn/tokens.h"

namespace vla {

CrossBlock::CrossBlock(const Scope& s, int d_model, int d_ff, int n_head, float eps)
    : Module(s),
      attn_norm_(s / "attn_norm", d_model, eps),
      attention_(s, d_model, d_model, Heads::even(d_model, n_head)),
      ffn_norm_(s / "ffn_norm", d_model, eps),
      mlp_(s, d_model, d_ff, Activation::gelu_erf) {}

Tensor CrossBlock::forward(Graph& g, Tensor x, Tensor time, const KeyValue& seen, Tensor mask) const {
  x = add(g, x, attention_(g, attn_norm_(g, x), {}, {seen}, mask));
  return add(g, x, mlp_(g, add(g, ffn_norm_(g, x), time)));
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
  for (const CrossBlock& block : blocks_) put(g, cache, block.path() + ".kept", block.project()(g, rows));
}

void CrossHead::prepare(Graph& g, Tensor context, std::span<const Kept> kept, int n_query, Cache& cache) const {
  std::vector<int> copies(static_cast<std::size_t>(context.dim(1)), 1);
  for (const Kept& rows : kept) copies.insert(copies.end(), static_cast<std::size_t>(rows.count), rows.copies);
  for (const CrossBlock& block : blocks_) {
    KeyValue seen = block.project()(g, context);
    for (const Kept& rows : kept) {
      const KeyValue all = get(g, cache, block.path() + ".kept");
      seen = {concat(g, {seen.key, slice_keys(g, all.key, rows.first, rows.count)}, 2),
              concat(g, {seen.value, slice_keys(g, all.value, rows.first, rows.count)}, 2)};
    }
    put(g, cache, block.path(), seen);
  }
  if (const Tensor mask = copies_mask(g, copies, n_query)) cache.put(g, path_ + ".mask", mask);
}

Tensor CrossHead::operator()(Graph& g, Tensor x, Tensor time, const Cache& cache) const {
  const std::string mask = path_ + ".mask";
  for (const CrossBlock& block : blocks_)
    x = block(g, x, time, get(g, cache, block.path()), cache.has(mask) ? cache.get(g, mask) : Tensor());
  return norm_(g, x);
}

}  // namespace vla
