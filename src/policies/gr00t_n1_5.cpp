// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// GR00T N1.5: Eagle 2.5 prefix (SigLIP, the first layers of Qwen3 and its final norm), self-attention over its
// features, a diffusion transformer over tokens of state, future and actions that attends to all features, flow
// matching from noise (t = 0) to actions (t = 1). Reference: lerobot 0.4.4 src/lerobot/policies/groot (groot_n1.py,
// action_head).

#include "modules/action/groot_head.h"
#include "modules/language/qwen.h"
#include "modules/language/view_places.h"
#include "modules/vision/siglip.h"
#include "nn/linear.h"
#include "policies/policy.h"

namespace vla {
namespace {

class Gr00tN15 final : public Policy {
  Siglip vision_;
  Qwen lm_;
  Linear projector_;
  ViewPlaces places_;
  GrootHead head_;

 public:
  static Keys published();

  explicit Gr00tN15(const Scope& s)
      : vision_(s / "vision"),
        lm_(s / "lm", kQwen3),
        projector_(s / "projector", vision_.d_model(), lm_.d_model(), Bias::yes),
        places_(s, vision_.n_position()),
        head_(s, lm_.d_model(), {.state_rows = false, .future_tokens = true, .mixing = true, .alternating = false}) {}

  Status check(const InputShape& shape) const override {
    VLA_CHECK(vision_.check(shape.width, shape.height));
    VLA_CHECK(places_.check(shape.n_view, shape.n_text));
    return check_prefix(0, 0, shape.n_text);  // views are part of the text
  }

  Tensor condition(Graph& g, std::span<const SolverTime> times) const override { return head_.condition(g, times); }

  void prefix(Graph& g, const PrefixInputs& in, Cache& cache) const override {
    const Tensor image = projector_(g, vision_(g, in.images));  // [d_model, n_view_token, n_view]
    g.end_stage("vision");
    const Tensor x = g.name("prefix", lm_.embed(g, in.tokens, image, places_));  // [d_model, n_text]
    const Tensor context = head_.context(g, lm_(g, x));
    head_.prepare(g, context, context, in.state, cache);
  }

  Tensor velocity(Graph& g, Tensor x_t, Tensor condition, const Cache& cache) const override {
    return head_.velocity(g, x_t, condition, cache);
  }
};

/// nvidia/GR00T-N1.5-3B with two views: 2.1 B parameters for one robot. Sources: Isaac-GR00T
/// gr00t/model/backbone/eagle2_hg_model/config.json, gr00t/model/action_head/flow_matching_action_head.py.
Keys Gr00tN15::published() {
  // clang-format off
  return Keys({
      {"policy.d_state", 64}, {"policy.d_action", 32}, {"policy.horizon", 16}, {"policy.n_position", 1024},
      {"policy.n_future", 32}, {"policy.max_views", 2}, {"policy.view_starts", std::vector<std::int64_t>{20, 283}},
      {"vision.d_model", 1152}, {"vision.n_layer", 27}, {"vision.n_head", 16}, {"vision.d_ff", 4304},
      {"vision.image_size", 224}, {"vision.patch_size", 14}, {"vision.norm_eps", 1e-6},
      {"vision.position_rule", "row_major"},
      {"lm.d_model", 2048}, {"lm.n_layer", 12}, {"lm.n_head", 16}, {"lm.n_head_kv", 8}, {"lm.d_head", 128},
      {"lm.d_ff", 6144}, {"lm.n_vocab", 151680}, {"lm.norm_eps", 1e-6}, {"lm.rope_base", 1e6},
      {"vl.n_layer", 4}, {"vl.n_head", 32}, {"vl.d_ff", 8192}, {"vl.norm_eps", 1e-5},
      {"dit.d_model", 1536}, {"dit.n_layer", 16}, {"dit.n_head", 32}, {"dit.d_ff", 6144}, {"dit.d_out", 1024},
      {"dit.d_time", 256}, {"dit.n_bucket", 1000}, {"dit.d_hidden", 1024}, {"dit.norm_eps", 1e-5},
      {"dit.out_eps", 1e-6}});
  // clang-format on
}

}  // namespace

PolicyEntry gr00t_n1_5_policy() { return policy_entry<Gr00tN15>("gr00t_n1_5"); }

}  // namespace vla
