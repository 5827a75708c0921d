// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// π0-FAST: PaliGemma answers an observation with tokens, one after the other, which FAST turns into a chunk
// (processor/action_tokens.h). Reference: lerobot src/lerobot/policies/pi0_fast/modeling_pi0_fast.py
// (sample_actions_fast_kv_cache).

#include "modules/language/paligemma.h"
#include "policies/policy.h"

namespace vla {
namespace {

class Pi0Fast final : public Policy {
  PaliGemma backbone_;  // observation rate and step rate

 public:
  static Keys published();

  explicit Pi0Fast(const Scope& s) : backbone_(s, DecoderOutput::logits) {}

  Status check(const InputShape& shape) const override {
    VLA_CHECK(backbone_.check(shape.width, shape.height));
    return check_prefix(shape.n_view, backbone_.n_token(shape.width), shape.n_text);
  }

  void prefix(Graph& g, const PrefixInputs& in, Cache& cache) const override {
    backbone_.prefill(g, in.images, in.tokens, cache);
  }

  Tensor decode(Graph& g, Tensor token, Tensor k, int n_token, Cache& cache) const override {
    return backbone_.next(g, token, k, n_token, cache);
  }
};

/// lerobot/pi0fast-base: 2.9 B parameters. Source: lerobot policies/pi0_fast/configuration_pi0_fast.py,
/// get_gemma_config.
Keys Pi0Fast::published() {
  return PaliGemma::published({{"policy.d_state", 0},
                               {"policy.d_action", 32},
                               {"policy.horizon", 50},
                               {"solver.kind", "greedy"},
                               {"solver.steps", 256},
                               {"solver.noise", "none"},
                               {"solver.stop_token", 235371}});
}

}  // namespace

PolicyEntry pi0_fast_policy() { return policy_entry<Pi0Fast>("pi0_fast"); }

}  // namespace vla
