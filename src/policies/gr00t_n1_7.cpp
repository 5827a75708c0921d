// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// GR00T N1.7: Qwen3-VL prefix whose features are read before the final norm, self-attention over them, a diffusion
// transformer that attends to text and images in turn, flow matching from noise (t = 0) to actions (t = 1). Reference:
// lerobot src/lerobot/policies/groot (groot_n1_7.py).

#include "modules/action/groot_head.h"
#include "modules/language/qwen3_vl.h"
#include "policies/policy.h"

namespace vla {
namespace {

class Gr00tN17 final : public Policy {
  Qwen3Vl backbone_;
  GrootHead head_;
  double ramp_rate_;

 public:
  static Keys published();

  explicit Gr00tN17(const Scope& s)
      : backbone_(s),
        head_(s, backbone_.d_model(),
              {.state_rows = false, .future_tokens = false, .mixing = true, .alternating = true}),
        ramp_rate_(s.precise("rtc_ramp_rate", {0, 1000})) {}

  RealTimeChunking real_time_chunking() const override { return {RealTimeChunking::Kind::inpainted, ramp_rate_}; }

  Status check(const InputShape& shape) const override {
    VLA_CHECK(backbone_.check(shape.width, shape.height, shape.n_view, shape.n_text));
    return check_prefix(0, 0, shape.n_text);  // views are part of the text
  }

  Tensor condition(Graph& g, std::span<const SolverTime> times) const override { return head_.condition(g, times); }

  void constants(Graph& g, const std::function<Tensor()>&, Cache& cache) const override { backbone_.keep(g, cache); }

  void prefix(Graph& g, const PrefixInputs& in, Cache& cache) const override {
    const Tensor context = head_.context(g, backbone_(g, in.images, in.tokens, cache));  // [d_model, n_text]
    const auto [image, text] = backbone_.places().split(g, context);
    head_.prepare(g, text, image, in.state, cache);
  }

  Tensor velocity(Graph& g, Tensor x_t, Tensor condition, const Cache& cache) const override {
    return head_.velocity(g, x_t, condition, cache);
  }
};

/// nvidia/GR00T-N1.7-3B with two views of 256 x 256: 2.8 B parameters for one robot. Sources: Isaac-GR00T
/// gr00t/configs/model/gr00t_n1d7.py, lerobot policies/groot/groot_n1_7.py.
Keys Gr00tN17::published() {
  // clang-format off
  return Keys({
      {"policy.d_state", 132}, {"policy.d_action", 132}, {"policy.horizon", 40}, {"policy.n_position", 1024},
      {"policy.rtc_ramp_rate", 6.0}, {"policy.max_views", 2}, {"policy.view_starts", std::vector<std::int64_t>{4, 70}},
      {"vision.d_model", 1024}, {"vision.n_layer", 24}, {"vision.n_head", 16}, {"vision.d_ff", 4096},
      {"vision.patch_size", 16}, {"vision.image_width", 256}, {"vision.image_height", 256},
      {"vision.n_position_side", 48}, {"vision.merge", 2}, {"vision.norm_eps", 1e-6}, {"vision.rope_base", 1e4},
      {"vision.deepstack_layers", std::vector<std::int64_t>{5, 11, 17}},
      {"lm.d_model", 2048}, {"lm.n_layer", 16}, {"lm.n_head", 16}, {"lm.n_head_kv", 8}, {"lm.d_head", 128},
      {"lm.d_ff", 6144}, {"lm.n_vocab", 151936}, {"lm.norm_eps", 1e-6}, {"lm.rope_base", 5e6},
      {"lm.rope_sections", std::vector<std::int64_t>{24, 20, 20}},
      {"vl.n_layer", 4}, {"vl.n_head", 32}, {"vl.d_ff", 8192}, {"vl.norm_eps", 1e-5},
      {"dit.d_model", 1536}, {"dit.n_layer", 32}, {"dit.n_head", 32}, {"dit.d_ff", 6144}, {"dit.d_out", 1024},
      {"dit.attend_text_every_n_blocks", 2}, {"dit.d_time", 256}, {"dit.n_bucket", 1000}, {"dit.d_hidden", 1024},
      {"dit.norm_eps", 1e-5}, {"dit.out_eps", 1e-6}});
  // clang-format on
}

}  // namespace

PolicyEntry gr00t_n1_7_policy() { return policy_entry<Gr00tN17>("gr00t_n1_7"); }

}  // namespace vla
