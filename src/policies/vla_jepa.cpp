// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// VLA-JEPA: Qwen3-VL prefix whose prompt ends in embodied action tokens, a diffusion transformer that attends to those
// tokens only, flow matching from noise (t = 0) to actions (t = 1). The world model (V-JEPA) is used in training only.
// Reference: lerobot src/lerobot/policies/vla_jepa (modeling_vla_jepa.py, action_head.py).

#include <fmt/format.h>

#include "modules/action/groot_head.h"
#include "modules/language/qwen3_vl.h"
#include "nn/tokens.h"
#include "policies/policy.h"

namespace vla {
namespace {

class VlaJepa final : public Policy {
  Qwen3Vl backbone_;
  GrootHead head_;
  int n_embodied_;

 public:
  static Keys published();

  /// The language model's last layer is read before the final norm (VLAJEPAModel._qwen_last_decoder_hidden).
  explicit VlaJepa(const Scope& s)
      : backbone_(s),
        head_(s, backbone_.d_model(),
              {.state_rows = false,
               .future_tokens = true,
               .mixing = false,
               .alternating = false,
               .norm = false,
               .may_lack_state = true}),
        n_embodied_(s.dim("n_embodied", 4096)) {}

  Status check(const InputShape& shape) const override {
    VLA_CHECK(backbone_.check(shape.width, shape.height, shape.n_view, shape.n_text - n_embodied_));
    return check_prefix(0, 0, shape.n_text);  // views are part of the text
  }

  Tensor condition(Graph& g, std::span<const SolverTime> times) const override { return head_.condition(g, times); }

  void constants(Graph& g, const std::function<Tensor()>&, Cache& cache) const override { backbone_.keep(g, cache); }

  /// Here the embodied tokens end the prompt. In the reference text follows, to which they do not attend.
  void prefix(Graph& g, const PrefixInputs& in, Cache& cache) const override {
    const Tensor features = backbone_(g, in.images, in.tokens, cache);  // [d_model, n_text]
    const int n_before = static_cast<int>(features.dim(1)) - n_embodied_;
    const Tensor embodied = slice_tokens(g, features, n_before, n_embodied_);
    head_.prepare(g, embodied, embodied, in.state, cache);
  }

  Tensor velocity(Graph& g, Tensor x_t, Tensor condition, const Cache& cache) const override {
    return head_.velocity(g, x_t, condition, cache);
  }
};

/// Qwen3-VL-2B and DiT-B with two views of LIBERO, 224 x 224 in the authors' training, 256 x 256 after the backbone's
/// processor: 2.3 B parameters. Sources: lerobot policies/vla_jepa/configuration_vla_jepa.py, starVLA.
Keys VlaJepa::published() {
  // clang-format off
  return Keys({
      {"policy.d_state", 8}, {"policy.d_action", 7}, {"policy.horizon", 7}, {"policy.n_position", 1024},
      {"policy.n_future", 32}, {"policy.n_embodied", 32},
      {"policy.max_views", 2}, {"policy.view_starts", std::vector<std::int64_t>{4, 70}},
      {"vision.d_model", 1024}, {"vision.n_layer", 24}, {"vision.n_head", 16}, {"vision.d_ff", 4096},
      {"vision.patch_size", 16}, {"vision.image_width", 256}, {"vision.image_height", 256},
      {"vision.n_position_side", 48}, {"vision.merge", 2}, {"vision.norm_eps", 1e-6}, {"vision.rope_base", 1e4},
      {"vision.deepstack_layers", std::vector<std::int64_t>{5, 11, 17}},
      {"lm.d_model", 2048}, {"lm.n_layer", 28}, {"lm.n_head", 16}, {"lm.n_head_kv", 8}, {"lm.d_head", 128},
      {"lm.d_ff", 6144}, {"lm.n_vocab", 151936}, {"lm.norm_eps", 1e-6}, {"lm.rope_base", 5e6},
      {"lm.rope_sections", std::vector<std::int64_t>{24, 20, 20}},
      {"dit.d_model", 768}, {"dit.n_layer", 16}, {"dit.n_head", 12}, {"dit.d_ff", 3072}, {"dit.d_out", 1024},
      {"dit.d_time", 256}, {"dit.n_bucket", 1000}, {"dit.d_hidden", 1024}, {"dit.norm_eps", 1e-5},
      {"dit.out_eps", 1e-6}});
  // clang-format on
}

}  // namespace

PolicyEntry vla_jepa_policy() { return policy_entry<VlaJepa>("vla_jepa"); }

}  // namespace vla
