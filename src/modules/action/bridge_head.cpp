// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/action/bridge_head.h"

#include <fmt/format.h>

#include "nn/tokens.h"

namespace vla {
namespace {

constexpr float kBase = 10000;  // base of the rotary embedding

}  // namespace

BridgeBlock::BridgeBlock(const Scope& s, int d_model, int n_head, BridgeVersion version, float eps)
    : Module(s),
      n_head_(n_head),
      version_(version),
      q_(s / "attn_q", d_model, d_model, Bias::yes),
      rows_(s, d_model, Heads::even(d_model, n_head)),
      gate_((s / "gate").vector("weight", 1)),
      out_(s / "attn_out", d_model, d_model, Bias::yes),
      norm_(s / "norm", d_model, eps),
      linear_(s / "linear", d_model, d_model, Bias::yes) {
  if (version_ == BridgeVersion::original) return;
  actions_.emplace(s / "actions", d_model, Heads::even(d_model, n_head));
  task_.emplace(s / "task", d_model, Heads::even(d_model, n_head));
}

void BridgeBlock::constants(Graph& g, Cache& cache) const {
  cache.put(g, path() + ".gate", tanh_of(g, g.parameter(gate_)));
}

/// [d_head, n_head, n] -> the same shape.
Tensor BridgeBlock::placed(Graph& g, Tensor heads) const {
  return version_ == BridgeVersion::pro ? apply_uneven_rope(g, heads, kBase) : heads;
}

KeyValue BridgeBlock::seen(Graph& g, const KeyValueProjection& projection, Tensor x) const {
  const KeyValue kv = projection(g, x);
  return {placed(g, kv.key), kv.value};
}

Tensor BridgeBlock::forward(Graph& g, Tensor x, Tensor actions, Tensor task, const Cache& cache) const {
  const Tensor q = placed(g, split_heads(g, q_(g, x), n_head_));
  const KeyValue of_rows = seen(g, rows_, x), of_actions = seen(g, actions_ ? *actions_ : rows_, actions);
  KeyValue of_task = seen(g, task_ ? *task_ : rows_, task);
  of_task.key = multiply(g, of_task.key, cache.get(g, path() + ".gate"));
  const Tensor y = out_(g, attention(g, q, {of_rows, of_actions, of_task}, {}));
  return activate(g, linear_(g, norm_(g, add(g, y, x))), Activation::relu);
}

BridgeHead::BridgeHead(const Scope& s, int d_model, int n_layer, int d_action, int horizon)
    : start_path_((s / "start").path()),
      d_in_(d_model * d_action),
      horizon_(horizon),
      in_norm_(s / "in_norm", d_in_, s.number("norm_eps", kNormEps)),
      in_(s / "in", d_in_, d_model, Bias::yes),
      out_norm_(s / "out_norm", d_model, s.number("norm_eps", kNormEps)),
      out_(s / "out", d_model, d_action, Bias::yes) {
  const auto version = static_cast<BridgeVersion>(s.choice("version", {"original", "pro"}));
  const int n_head = s.dim("n_head", 1024), multiple = version == BridgeVersion::pro ? 2 * n_head : n_head;
  s.require(d_model % multiple == 0, "n_head",
            fmt::format("heads that divide lm.d_model {}, in version pro into an even width", d_model),
            std::to_string(n_head));
  for (int i = 0; i < n_layer; ++i)
    blocks_.emplace_back(s / "blk" / i, d_model, n_head, version, s.number("norm_eps", kNormEps));
}

void BridgeHead::constants(Graph& g, Cache& cache) const {
  // The reference's rows are zeros before the first norm.
  const Tensor rows = in_(g, in_norm_(g, full(g, 0, d_in_, horizon_)));
  cache.put(g, start_path_, activate(g, rows, Activation::relu));
  for (const BridgeBlock& block : blocks_) block.constants(g, cache);
}

}  // namespace vla
