// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/action/groot_head.h"

#include <fmt/format.h>

#include <cmath>

#include "nn/tokens.h"

namespace vla {

GrootHead::GrootHead(const Scope& s, int d_context, GrootFamily family)
    : vl_norm_(family.norm ? std::make_optional<LayerNorm>(s / "vl" / "norm", d_context,
                                                           (s / "vl").number("norm_eps", kNormEps))
                           : std::nullopt),
      d_state_(family.may_lack_state ? s.index("d_state", 1 << 16) : s.dim("d_state")),
      n_state_row_(d_state_ == 0       ? 0
                   : family.state_rows ? s.dim("n_state_row", 64)
                                       : 1),
      state_in_(d_state_ > 0 ? std::make_optional<Linear>(s / "state_in", d_state_ / n_state_row_,
                                                          (s / "dit").dim("d_hidden"), Bias::yes)
                             : std::nullopt),
      state_out_(d_state_ > 0 ? std::make_optional<Linear>(s / "state_out", (s / "dit").dim("d_hidden"),
                                                           (s / "dit").dim("d_model"), Bias::yes)
                              : std::nullopt),
      n_future_(family.future_tokens ? s.dim("n_future", 4096) : 0),
      dit_(s / "dit", d_context, family.alternating),
      action_in_(s / "action_in", s.dim("d_action"), dit_.d_model(), Bias::yes),
      action_mix_(s / "action_mix", 2 * dit_.d_model(), dit_.d_model(), Bias::yes),
      action_token_(s / "action_token", dit_.d_model(), dit_.d_model(), Bias::yes),
      decode_in_(s / "decode_in", dit_.d_out(), (s / "dit").dim("d_hidden"), Bias::yes),
      decode_out_(s / "decode_out", (s / "dit").dim("d_hidden"), s.dim("d_action"), Bias::yes),
      action_position_(s / "action_position", dit_.d_model(), s.dim("n_position")),
      d_time_((s / "dit").dim("d_time")),
      n_bucket_((s / "dit").dim("n_bucket")),
      horizon_(s.dim("horizon", 4096)),
      time_in_(s / "time_in", d_time_, dit_.d_model(), Bias::yes),
      time_out_(s / "time_out", dit_.d_model(), dit_.d_model(), Bias::yes) {
  if (family.future_tokens) future_.emplace(s / "future", dit_.d_model(), n_future_);
  if (family.mixing) {
    const Scope vl = s / "vl";
    const int n_layer = vl.index("n_layer", 513), n_head = vl.dim("n_head", 1024);  // a model may have no such layers
    for (int i = 0; i < n_layer; ++i)
      vl_blocks_.emplace_back(vl / "blk" / i, d_context, n_head, vl.dim("d_ff"), vl.number("norm_eps", kNormEps));
    vl.require(n_layer == 0 || d_context % n_head == 0, "n_head", fmt::format("a divisor of lm.d_model {}", d_context),
               std::to_string(n_head));
  }
  s.require(d_state_ == 0 || d_state_ % n_state_row_ == 0, "n_state_row",
            fmt::format("a divisor of policy.d_state {}", d_state_), std::to_string(n_state_row_));
  s.require(horizon_ <= s.dim("n_position"), "n_position", fmt::format("at least the horizon {}", horizon_),
            std::to_string(s.dim("n_position")));
  (s / "dit").require(d_time_ % 2 == 0 && d_time_ > 2, "d_time", "an even number above 2", std::to_string(d_time_));
  (s / "dit").require(dit_.d_model() % 2 == 0, "d_model", "an even number", std::to_string(dit_.d_model()));
}

Tensor GrootHead::condition(Graph& g, std::span<const SolverTime> times) const {
  // The reference discretizes the time in double.
  std::vector<float> buckets;
  for (const SolverTime& time : times) buckets.push_back(static_cast<float>(std::trunc(time.exact * n_bucket_)));
  const auto embedded = [&](int d, TimeWaves waves) {
    return g.constant(wave_embedding(buckets, d, waves), {d, static_cast<std::int64_t>(buckets.size()), 1, 1});
  };
  const Tensor hidden = silu(g, time_in_(g, embedded(d_time_, TimeWaves::cosines_first)));
  const Tensor modulations = dit_.modulations(g, silu(g, time_out_(g, hidden)));
  return concat_features(g, modulations, embedded(dit_.d_model(), TimeWaves::sines_first));
}

Tensor GrootHead::context(Graph& g, Tensor features) const {
  Tensor x = (*vl_norm_)(g, features);
  for (const EncoderBlock& block : vl_blocks_) x = block(g, x);
  return x;
}

void GrootHead::prepare(Graph& g, Tensor text, Tensor image, Tensor state, Cache& cache) const {
  dit_.prepare(g, text, image, cache);
  if (state_in_) {
    const Tensor rows = n_state_row_ > 1 ? reshape_width(g, state, d_state_ / n_state_row_) : state;
    const Tensor hidden = activate(g, (*state_in_)(g, rows), Activation::relu);
    cache.put(g, state_out_->path(), state_out_->forward(g, hidden));  // [d_dit, n_state_row]
  }
  if (future_) cache.put(g, future_->path(), future_->forward(g, arange(g, n_future_)));
}

Tensor GrootHead::velocity(Graph& g, Tensor x_t, Tensor condition, const Cache& cache) const {
  const Tensor action = action_in_(g, x_t);  // [d_dit, horizon]
  const Tensor time = slice_features(g, condition, dit_.d_modulations(), dit_.d_model());
  const Tensor timed = concat_features(g, action, repeat_like(g, time, action));
  const Tensor token = action_token_.forward(g, silu(g, action_mix_(g, timed)));
  const Tensor placed = add(g, token, action_position_(g, arange(g, horizon_)));
  std::vector<Tensor> tokens;
  if (state_out_) tokens.push_back(cache.get(g, state_out_->path()));
  if (future_) tokens.push_back(cache.get(g, future_->path()));
  tokens.push_back(g.name(action_token_.path(), placed));
  const Tensor x = dit_(g, concat_tokens(g, tokens), condition, cache);
  const Tensor out = slice_tokens(g, x, n_state_row_ + n_future_, horizon_);  // [d_out, horizon]
  return decode_out_(g, activate(g, decode_in_(g, out), Activation::relu));   // [d_action, horizon]
}

}  // namespace vla
