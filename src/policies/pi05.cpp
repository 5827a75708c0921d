// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// π0.5: like π0, but the prompt contains the discretized state in place of a state token, and the time modulates every
// norm of the expert. Reference: lerobot src/lerobot/policies/pi05/modeling_pi05.py (embed_prefix, embed_suffix,
// denoise_step).

#include "modules/action/gemma_expert.h"
#include "modules/language/paligemma.h"
#include "modules/timestep_embedding.h"
#include "policies/policy.h"

namespace vla {
namespace {

class Pi05 final : public Policy {
  PaliGemma backbone_;  // observation rate
  GemmaExpert expert_;
  Linear action_in_, action_out_;      // step rate
  Linear time_mlp_in_, time_mlp_out_;  // load rate
  TimestepEmbedding time_;

 public:
  static Keys published();

  explicit Pi05(const Scope& s)
      : backbone_(s),
        expert_(s / "expert", backbone_.lm(), ExpertNorm::adaptive),
        action_in_(s / "action_in", s.dim("d_action"), expert_.d_model(), Bias::yes),
        action_out_(s / "action_out", expert_.d_model(), s.dim("d_action"), Bias::yes),
        time_mlp_in_(s / "time_mlp_in", expert_.d_model(), expert_.d_model(), Bias::yes),
        time_mlp_out_(s / "time_mlp_out", expert_.d_model(), expert_.d_model(), Bias::yes),
        time_(s / "time", expert_.d_model()) {}

  RealTimeChunking real_time_chunking() const override { return {RealTimeChunking::Kind::guided}; }

  Status check(const InputShape& shape) const override {
    VLA_CHECK(backbone_.check(shape.width, shape.height));
    return check_prefix(shape.n_view, backbone_.n_token(shape.width), shape.n_text);
  }

  Tensor condition(Graph& g, std::span<const SolverTime> times) const override {
    const Tensor hidden = silu(g, time_mlp_in_(g, time_(g, times)));   // [d_expert, n_time]
    return expert_.modulations(g, silu(g, time_mlp_out_(g, hidden)));  // [3 * d_expert * n_norm, n_time]
  }

  void prefix(Graph& g, const PrefixInputs& in, Cache& cache) const override {
    backbone_.prefill(g, in.images, in.tokens, cache);
  }

  Tensor velocity(Graph& g, Tensor x_t, Tensor modulations, const Cache& cache) const override {
    return action_out_(g, expert_(g, action_in_(g, x_t), modulations, cache));  // [d_action, horizon]
  }
};

/// lerobot/pi05_base: 3.4 B parameters. Source: lerobot policies/pi05/configuration_pi05.py, get_gemma_config.
Keys Pi05::published() {
  return PaliGemma::published(GemmaExpert::published({{"policy.d_state", 0},
                                                      {"policy.d_action", 32},
                                                      {"policy.horizon", 50},
                                                      {"time.min_period", 4e-3},
                                                      {"time.max_period", 4.0}}));
}

}  // namespace

PolicyEntry pi05_policy() { return policy_entry<Pi05>("pi05"); }

}  // namespace vla
