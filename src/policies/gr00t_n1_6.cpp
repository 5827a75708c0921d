// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// GR00T N1.6: Eagle 3 prefix (SigLIP 2, the first layers of Qwen3 and its final norm) with the views after the
// instruction, a diffusion transformer that attends to text and images in turn, flow matching from noise (t = 0) to
// actions (t = 1). References: Isaac-GR00T gr00t/model/gr00t_n1d6/gr00t_n1d6.py; transformers modeling_siglip2.py,
// modeling_qwen3.py; lerobot src/lerobot/policies/groot (groot_n1_7.py).

#include "modules/action/groot_head.h"
#include "modules/language/qwen.h"
#include "modules/language/view_places.h"
#include "modules/vision/mlp_connector.h"
#include "modules/vision/siglip2.h"
#include "policies/policy.h"

namespace vla {
namespace {

class Gr00tN16 final : public Policy {
  Siglip2 vision_;
  Qwen lm_;
  MlpConnector connector_;
  ViewPlaces places_;
  GrootHead head_;

 public:
  static Keys published();

  explicit Gr00tN16(const Scope& s)
      : vision_(s / "vision"),
        lm_(s / "lm", kQwen3),
        connector_(s / "connector", vision_.d_model(), lm_.d_model(), vision_.n_row(), vision_.n_column()),
        places_(s, connector_.n_token(), ViewPlaces::Count::from_end),
        head_(s, lm_.d_model(), {.state_rows = true, .future_tokens = false, .mixing = false, .alternating = true}) {}

  Status check(const InputShape& shape) const override {
    VLA_CHECK(vision_.check(shape.width, shape.height));
    VLA_CHECK(places_.check(shape.n_view, shape.n_text));
    return check_prefix(0, 0, shape.n_text);  // views are part of the text
  }

  Tensor condition(Graph& g, std::span<const SolverTime> times) const override { return head_.condition(g, times); }

  void constants(Graph& g, const std::function<Tensor()>&, Cache& cache) const override { vision_.keep(g, cache); }

  void prefix(Graph& g, const PrefixInputs& in, Cache& cache) const override {
    const Tensor image = connector_(g, vision_(g, in.images, cache));
    g.end_stage("vision");
    const Tensor x = g.name("prefix", lm_.embed(g, in.tokens, image, places_));  // [d_model, n_text]
    const auto [images, text] = places_.split(g, head_.context(g, lm_(g, x)));
    head_.prepare(g, text, images, in.state, cache);
  }

  Tensor velocity(Graph& g, Tensor x_t, Tensor condition, const Cache& cache) const override {
    return head_.velocity(g, x_t, condition, cache);
  }
};

/// nvidia/GR00T-N1.6-3B with two views of 252 x 252: 2.7 B parameters for one robot. Sources: Isaac-GR00T
/// gr00t/configs/model/gr00t_n1d6.py, gr00t/model/modules/nvidia/Eagle-Block2A-2B-v2/config.json.
Keys Gr00tN16::published() {
  // clang-format off
  return Keys({
      {"policy.d_state", 128}, {"policy.d_action", 128}, {"policy.horizon", 50}, {"policy.n_position", 1024},
      {"policy.n_state_row", 1}, {"policy.max_views", 2}, {"policy.view_starts_from_end", std::vector<std::int64_t>{172, 84}},
      {"vision.d_model", 1152}, {"vision.n_layer", 27}, {"vision.n_head", 16}, {"vision.d_ff", 4304},
      {"vision.image_width", 252}, {"vision.image_height", 252}, {"vision.patch_size", 14},
      {"vision.n_position_side", 16}, {"vision.norm_eps", 1e-6}, {"connector.factor", 2}, {"connector.norm_eps", 1e-5},
      {"lm.d_model", 2048}, {"lm.n_layer", 16}, {"lm.n_head", 16}, {"lm.n_head_kv", 8}, {"lm.d_head", 128},
      {"lm.d_ff", 6144}, {"lm.n_vocab", 151680}, {"lm.norm_eps", 1e-6}, {"lm.rope_base", 1e6},
      {"vl.norm_eps", 1e-5},
      {"dit.d_model", 1536}, {"dit.n_layer", 32}, {"dit.n_head", 32}, {"dit.d_ff", 6144}, {"dit.d_out", 1024},
      {"dit.attend_text_every_n_blocks", 2}, {"dit.d_time", 256}, {"dit.n_bucket", 1000}, {"dit.d_hidden", 1024},
      {"dit.norm_eps", 1e-5}, {"dit.out_eps", 1e-6}});
  // clang-format on
}

}  // namespace

PolicyEntry gr00t_n1_6_policy() { return policy_entry<Gr00tN16>("gr00t_n1_6"); }

}  // namespace vla
