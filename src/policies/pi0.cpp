// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// π0: PaliGemma prefix, a narrower Gemma as action expert that attends to it layer by layer, flow matching from noise
// (t = 1) to actions (t = 0). Reference: lerobot src/lerobot/policies/pi0/modeling_pi0.py (embed_prefix, embed_suffix,
// denoise_step).

#include "modules/action/gemma_expert.h"
#include "modules/language/paligemma.h"
#include "modules/timestep_embedding.h"
#include "nn/tokens.h"
#include "policies/policy.h"

namespace vla {
namespace {

class Pi0 final : public Policy {
  PaliGemma backbone_;  // observation rate
  GemmaExpert expert_;
  Linear state_in_;                                                   // observation rate
  Linear action_in_, action_time_in_, action_time_out_, action_out_;  // step rate
  TimestepEmbedding time_;                                            // load rate

 public:
  static Keys published();

  explicit Pi0(const Scope& s)
      : backbone_(s),
        expert_(s / "expert", backbone_.lm(), ExpertNorm::weighted),
        state_in_(s / "state_in", s.dim("d_state"), expert_.d_model(), Bias::yes),
        action_in_(s / "action_in", s.dim("d_action"), expert_.d_model(), Bias::yes),
        action_time_in_(s / "action_time_in", 2 * expert_.d_model(), expert_.d_model(), Bias::yes),
        action_time_out_(s / "action_time_out", expert_.d_model(), expert_.d_model(), Bias::yes),
        action_out_(s / "action_out", expert_.d_model(), s.dim("d_action"), Bias::yes),
        time_(s / "time", expert_.d_model()) {}

  RealTimeChunking real_time_chunking() const override { return {RealTimeChunking::Kind::guided}; }

  Status check(const InputShape& shape) const override {
    VLA_CHECK(backbone_.check(shape.width, shape.height));
    return check_prefix(shape.n_view, backbone_.n_token(shape.width), shape.n_text + 1);
  }

  Tensor condition(Graph& g, std::span<const SolverTime> times) const override { return time_(g, times); }

  void prefix(Graph& g, const PrefixInputs& in, Cache& cache) const override {
    backbone_.prefill(g, in.images, in.tokens, cache);
    // The state is a token of the expert. It never sees the actions, so its keys and values belong to the cache.
    expert_.prefill(g, state_in_(g, in.state), cache);
  }

  Tensor velocity(Graph& g, Tensor x_t, Tensor time, const Cache& cache) const override {
    const Tensor action = action_in_(g, x_t);  // [d_expert, horizon]
    const Tensor mixed =
        action_time_in_(g, concat_features(g, action, repeat_like(g, time, action)));  // [d_expert, horizon]
    const Tensor x = action_time_out_(g, silu(g, mixed));                              // [d_expert, horizon]
    return action_out_(g, expert_(g, x, {}, cache));                                   // [d_action, horizon]
  }
};

/// lerobot/pi0_base: 3.2 B parameters. Source: lerobot policies/pi0/configuration_pi0.py, get_gemma_config.
Keys Pi0::published() {
  return PaliGemma::published(GemmaExpert::published({{"policy.d_state", 32},
                                                      {"policy.d_action", 32},
                                                      {"policy.horizon", 50},
                                                      {"time.min_period", 4e-3},
                                                      {"time.max_period", 4.0}}));
}

}  // namespace

PolicyEntry pi0_policy() { return policy_entry<Pi0>("pi0"); }

}  // namespace vla
