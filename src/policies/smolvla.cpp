// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// SmolVLA: SmolVLM prefix, a narrower action expert that alternates self and cross attention, flow matching from noise
// (t = 1) to actions (t = 0). Reference: lerobot src/lerobot/policies/smolvla/modeling_smolvla.py (embed_prefix,
// embed_suffix, denoise_step) and smolvlm_with_expert.py.

#include <fmt/format.h>

#include "modules/action/expert.h"
#include "modules/language/decoder.h"
#include "modules/timestep_embedding.h"
#include "modules/vision/pixel_connector.h"
#include "modules/vision/siglip.h"
#include "nn/attention.h"
#include "nn/linear.h"
#include "nn/tokens.h"
#include "policies/policy.h"

namespace vla {
namespace {

class SmolVla final : public Policy {
  Siglip vision_;
  Decoder lm_;
  PixelConnector connector_;
  Linear state_in_;  // observation rate
  Expert expert_;
  Linear action_in_, action_time_in_, action_time_out_, action_out_;  // step rate
  float image_scale_, text_scale_;
  TimestepEmbedding time_;  // load rate

 public:
  static Keys published();

  explicit SmolVla(const Scope& s)
      : vision_(s / "vision"),
        lm_(s / "lm", kSmolLm),
        connector_(s / "connector", vision_.d_model(), lm_.d_model()),
        state_in_(s / "state_in", s.dim("d_state"), lm_.d_model(), Bias::yes),
        expert_(s / "expert", lm_),
        action_in_(s / "action_in", s.dim("d_action"), expert_.d_model(), Bias::yes),
        action_time_in_(s / "action_time_in", 2 * expert_.d_model(), expert_.d_model(), Bias::yes),
        action_time_out_(s / "action_time_out", expert_.d_model(), expert_.d_model(), Bias::yes),
        action_out_(s / "action_out", expert_.d_model(), s.dim("d_action"), Bias::yes),
        image_scale_(s.number("image_scale", kTokenScale)),
        text_scale_(s.number("text_scale", kTokenScale)),
        time_(s / "time", expert_.d_model()) {}

  RealTimeChunking real_time_chunking() const override { return {RealTimeChunking::Kind::guided}; }

  Status check(const InputShape& shape) const override {
    VLA_CHECK(vision_.check(shape.width, shape.height));
    const int side = shape.width / vision_.patch_size();
    VLA_CHECK(connector_.check(side));
    return check_prefix(shape.n_view, connector_.n_token(side), shape.n_text + 1);
  }

  Tensor condition(Graph& g, std::span<const SolverTime> times) const override { return time_(g, times); }

  void prefix(Graph& g, const PrefixInputs& in, Cache& cache) const override {
    const Tensor view = connector_(g, vision_(g, in.images));  // [d_model, n_token, n_view]
    g.end_stage("vision");
    const Tensor image = flatten_views(g, view);  // [d_model, n_token * n_view]
    const Tensor text = lm_.embed(g, in.tokens);  // [d_model, n_text]
    const Tensor state = state_in_(g, in.state);  // [d_model, 1]
    const Tensor x =
        g.name("prefix", concat_tokens(g, {scale(g, image, image_scale_), scale(g, text, text_scale_), state}));
    // Images and text attend to each other and not to the state; the state attends to everything.
    const int groups[] = {static_cast<int>(image.dim(1) + text.dim(1)), 1};
    lm_.prefill(g, x, group_mask(g, groups), cache);
    expert_.prepare(g, cache);
  }

  Tensor velocity(Graph& g, Tensor x_t, Tensor time, const Cache& cache) const override {
    const Tensor action = action_in_(g, x_t);  // [d_expert, horizon]
    const Tensor mixed =
        action_time_in_(g, concat_features(g, action, repeat_like(g, time, action)));  // [d_expert, horizon]
    const Tensor x = action_time_out_(g, silu(g, mixed));                              // [d_expert, horizon]
    return action_out_(g, expert_(g, x, cache));                                       // [d_action, horizon]
  }
};

/// lerobot/smolvla_base: 450 M parameters. Source: its config.json and that of its backbone.
Keys SmolVla::published() {
  // clang-format off
  return Keys({
      {"policy.d_state", 32}, {"policy.d_action", 32}, {"policy.horizon", 50},
      {"policy.image_scale", 30.983866769659336}, {"policy.text_scale", 30.983866769659336},
      {"vision.d_model", 768}, {"vision.n_layer", 12}, {"vision.n_head", 12}, {"vision.d_ff", 3072},
      {"vision.image_size", 512}, {"vision.patch_size", 16}, {"vision.norm_eps", 1e-6},
      {"vision.position_rule", "bucketize_float32"},
      {"connector.factor", 4},
      {"lm.d_model", 960}, {"lm.n_layer", 16}, {"lm.n_head", 15}, {"lm.n_head_kv", 5}, {"lm.d_head", 64},
      {"lm.d_ff", 2560}, {"lm.n_vocab", 49280}, {"lm.norm_eps", 1e-5}, {"lm.rope_base", 10000.0},
      {"expert.d_model", 720}, {"expert.n_layer", 16}, {"expert.d_ff", 2048}, {"expert.norm_eps", 1e-5},
      {"expert.rope_base", 10000.0},
      {"expert.layer_kinds", std::vector<std::string>{"self", "cross", "self", "cross", "self", "cross", "self", "cross",
                                                      "self", "cross", "self", "cross", "self", "cross", "self", "cross"}},
      {"time.min_period", 4e-3}, {"time.max_period", 4.0}});
  // clang-format on
}

}  // namespace

PolicyEntry smolvla_policy() { return policy_entry<SmolVla>("smolvla"); }

}  // namespace vla
