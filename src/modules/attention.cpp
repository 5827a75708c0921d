// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/attention.h"

#include <fmt/format.h>

#include <numeric>

namespace vla {

Heads Heads::read(const Scope& s, RotaryAngle angle) {
  const Heads heads = {.n_head = s.dim("n_head", 1024),
                       .n_head_kv = s.dim("n_head_kv", 1024),
                       .d_head = s.dim("d_head"),
                       .rope_base = s.number("rope_base", kRopeBase),
                       .rope_angle = angle};
  s.require(heads.n_head % heads.n_head_kv == 0, "n_head_kv", fmt::format("a divisor of n_head {}", heads.n_head),
            std::to_string(heads.n_head_kv));
  s.require(heads.d_head % 2 == 0, "d_head", "an even number, for the rotary pairs", std::to_string(heads.d_head));
  return heads;
}

Tensor Heads::rotary(Graph& g, int first, int count) const {
  std::vector<int> positions(static_cast<std::size_t>(count));
  std::iota(positions.begin(), positions.end(), first);
  return rotary_table(g, d_head, rope_base, rope_angle, positions);
}

void put(Graph& g, Cache& cache, const std::string& path, const KeyValue& kv) {
  cache.put(g, path + ".k", kv.key);
  cache.put(g, path + ".v", kv.value);
}

KeyValue get(Graph& g, const Cache& cache, const std::string& path) {
  return {cache.get(g, path + ".k"), cache.get(g, path + ".v")};
}

namespace {

std::optional<RmsNorm> head_norm(const Scope& s, const Heads& heads) {
  return heads.norm_eps ? std::optional(RmsNorm(s, heads.d_head, *heads.norm_eps)) : std::nullopt;
}

/// [n_head * d_head, n, ...] -> [d_head, n_head, n, ...], normalized if `norm` is set and rotated if `rotary` is.
Tensor head_rows(Graph& g, Tensor x, int n_head, const std::optional<RmsNorm>& norm, Tensor rotary) {
  x = split_heads(g, x, n_head);
  if (norm) x = (*norm)(g, x);
  return rotary ? apply_rope(g, x, rotary) : x;
}

}  // namespace

KeyValueProjection::KeyValueProjection(const Scope& s, int d_context, const Heads& heads)
    : n_head_(heads.n_head_kv),
      k_(s / "attn_k", d_context, heads.d_key(), heads.plain_keys ? Bias::no : heads.bias, heads.rule),
      v_(s / "attn_v", d_context, heads.d_key(), heads.bias, heads.rule),
      norm_(head_norm(s / "attn_k_norm", heads)) {}

KeyValue KeyValueProjection::operator()(Graph& g, Tensor key_context, Tensor value_context, Tensor rotary) const {
  return {head_rows(g, k_(g, key_context), n_head_, norm_, rotary), split_heads(g, v_(g, value_context), n_head_)};
}

Attention::Attention(const Scope& s, int d_model, int d_context, const Heads& heads)
    : heads_(heads),
      heads_path_((s / "attn_heads").path()),
      q_(s / "attn_q", d_model, heads.d_query(), heads.bias, heads.rule),
      norm_(head_norm(s / "attn_q_norm", heads)),
      kv_(s, d_context, heads),
      out_(s / "attn_out", heads.d_query(), d_model, heads.out_bias, heads.rule) {
  if (heads.sub_norm_eps) sub_norm_.emplace(s / "attn_sub_norm", heads.d_query(), *heads.sub_norm_eps);
}

Tensor Attention::operator()(Graph& g, Tensor x, Tensor rotary, const std::vector<KeyValue>& segments,
                             Tensor mask) const {
  const Tensor q = head_rows(g, q_(g, x), heads_.n_head, norm_, rotary);
  const Tensor y = g.name(heads_path_, attention(g, q, segments, mask));
  return out_(g, sub_norm_ ? (*sub_norm_)(g, y) : y);
}

}  // namespace vla
