// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// TurboVLA: DINOv3 over the views and BERT over the instruction, layers in which the two attend to each other, and a
// decoder that turns one learned query per chunk row into an action. No language model, no noise, one pass. Reference:
// lerobot_policy_turbovla modeling_turbovla.py (TurboVLA.forward), vl_interaction.py, action_decoder.py.

#include <fmt/format.h>

#include "modules/fusion.h"
#include "modules/language/bert.h"
#include "modules/vision/dinov3.h"
#include "nn/tokens.h"
#include "policies/policy.h"

namespace vla {
namespace {

class TurboVla final : public Policy {
  int d_state_, horizon_, n_view_;
  DetrFamily family_;
  DinoV3 vision_;  // observation rate
  Bert lm_;
  Linear projector_, text_in_;
  Embedding position_, camera_;
  std::optional<Linear> state_in_;
  const Param* state_token_ = nullptr;
  std::vector<FusionLayer> fusion_;
  LayerNorm image_norm_, text_norm_;
  Embedding query_;  // step rate
  DetrDecoder decoder_;
  LayerNorm decoder_norm_;
  Linear action_out_;

 public:
  static Keys published();

  explicit TurboVla(const Scope& s)
      : d_state_(s.index("d_state", 1 << 16)),
        horizon_(s.dim("horizon", 4096)),
        n_view_(s.dim("n_view", 32)),
        family_(DetrFamily::read(s / "transformer")),
        vision_(s / "vision"),
        lm_(s / "lm"),
        projector_(s / "projector", vision_.d_model(), family_.d_model, Bias::yes),
        text_in_(s / "text_in", lm_.d_model(), family_.d_model, Bias::yes),
        position_(s / "position", family_.d_model, vision_.n_patch()),
        camera_(s / "camera", family_.d_model, n_view_),
        image_norm_(s / "fusion" / "image_norm", family_.d_model, family_.norm_eps),
        text_norm_(s / "fusion" / "text_norm", family_.d_model, family_.norm_eps),
        query_(s / "query", family_.d_model, horizon_),
        decoder_norm_(s / "decoder" / "norm", family_.d_model, family_.norm_eps),
        action_out_(s / "action_out", family_.d_model, s.dim("d_action"), Bias::yes) {
    (s / "transformer").require(family_.pre_norm, "norm", "before", "after");
    if (d_state_ > 0) {
      state_in_.emplace(s / "state_in", d_state_, family_.d_model, Bias::yes);
      state_token_ = (s / "state_token").vector("weight", family_.d_model);
    }
    const int n_fusion = (s / "fusion").n_layer("n_layer"), n_decoder = (s / "decoder").n_layer("n_layer");
    for (int i = 0; i < n_fusion; ++i) fusion_.emplace_back(s / "fusion" / "blk" / i, family_);
    decoder_ = DetrDecoder(s / "decoder", family_, n_decoder);
  }

  Status check(const InputShape& shape) const override {
    VLA_CHECK(vision_.check(shape.width, shape.height));
    VLA_CHECK(lm_.check(shape.n_text));
    VLA_CHECK(check_views("policy.n_view", shape.n_view, n_view_));
    return check_prefix(shape.n_view, vision_.n_patch(), shape.n_text + 1);
  }

  /// Each camera has a row in an embedding table.
  bool depends_on_which_views() const override { return true; }

  /// Computes the queries' self-attention in the first layer, which is the same for every observation.
  void constants(Graph& g, const std::function<Tensor()>& /*absent_view*/, Cache& cache) const override {
    decoder_.constants(g, query_(g, arange(g, horizon_)), {}, cache);
  }

  void prefix(Graph& g, const PrefixInputs& in, Cache& cache) const override {
    const Tensor image = projector_(g, vision_(g, in.images));  // [d_model, n_patch, n_view]
    g.end_stage("vision");
    Streams x = {image_tokens(g, image, in), text_in_(g, lm_(g, in.tokens))};
    for (const FusionLayer& layer : fusion_) x = layer(g, x);
    const Tensor seen = image_norm_(g, x.image);
    const Tensor memory = g.name("prefix", concat_tokens(g, {seen, text_norm_(g, x.text)}));
    decoder_.prefix(g, memory, {}, cache);
  }

  Tensor velocity(Graph& g, Tensor /*x_t*/, Tensor /*condition*/, const Cache& cache) const override {
    return action_out_(g, decoder_norm_(g, decoder_(g, {}, cache)));  // [d_action, horizon]
  }

 private:
  /// The state token, if any, and the patches of all views with their place and camera embeddings.
  Tensor image_tokens(Graph& g, Tensor image, const PrefixInputs& in) const {
    std::vector<std::int32_t> present;
    for (int i = 0; i < n_view_; ++i)
      if ((in.views >> i & 1) != 0) present.push_back(i);
    const Tensor rows = camera_(g, constant_ids(g, fmt::format("cameras/{}", in.views), present));
    const Tensor cameras = g.add(op::Reshape{}, {rows}, {rows.dim(0), 1, rows.dim(1), 1});
    const Tensor placed = add(g, image, position_(g, arange(g, vision_.n_patch())));
    const Tensor tokens = flatten_views(g, add(g, placed, cameras));  // [d_model, n_patch * n_view]
    if (!state_in_) return tokens;
    return concat_tokens(g, {add(g, (*state_in_)(g, in.state), g.parameter(state_token_)), tokens});
  }
};

/// The published size, with LIBERO's robot: two cameras, 0.2 B parameters. Sources: lerobot_policy_turbovla
/// configuration_turbovla.py, and the configs of facebook/dinov3-vitb16-pretrain-lvd1689m and
/// google-bert/bert-base-uncased.
Keys TurboVla::published() {
  // clang-format off
  return Keys({
      {"policy.d_state", 8}, {"policy.d_action", 7}, {"policy.horizon", 12}, {"policy.n_view", 2},
      {"vision.d_model", 768}, {"vision.n_layer", 12}, {"vision.n_head", 12}, {"vision.d_ff", 3072},
      {"vision.image_size", 224}, {"vision.patch_size", 16}, {"vision.norm_eps", 1e-5}, {"vision.rope_base", 100.0},
      {"vision.n_register", 4},
      {"lm.d_model", 768}, {"lm.n_layer", 12}, {"lm.n_head", 12}, {"lm.d_ff", 3072}, {"lm.n_vocab", 30522},
      {"lm.n_position", 512}, {"lm.norm_eps", 1e-12},
      {"transformer.d_model", 256}, {"transformer.n_head", 8}, {"transformer.d_ff", 1024},
      {"transformer.activation", "relu"}, {"transformer.norm", "before"}, {"transformer.norm_eps", 1e-5},
      {"fusion.n_layer", 6}, {"decoder.n_layer", 4},
      {"solver.kind", "direct"}, {"solver.steps", 1}, {"solver.noise", "none"}});
  // clang-format on
}

}  // namespace

PolicyEntry turbovla_policy() { return policy_entry<TurboVla>("turbovla"); }

}  // namespace vla
