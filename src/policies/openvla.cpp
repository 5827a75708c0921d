// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// OpenVLA: patches of DINOv2 and SigLIP side by side, an MLP, and a Llama 2 that answers one token for each number of
// an action. Both towers end before their last block. Reference: openvla prismatic/extern/hf/modeling_prismatic.py
// (PrismaticForConditionalGeneration.forward, OpenVLAForActionPrediction.predict_action)

#include "modules/language/decoder.h"
#include "modules/vision/dinov2.h"
#include "modules/vision/siglip.h"
#include "nn/tokens.h"
#include "policies/policy.h"

namespace vla {
namespace {

constexpr EncoderFamily kTimmSiglip = {Activation::gelu_erf, false};
constexpr DecoderFamily kLlama = {Activation::silu, RotaryAngle::product};

class OpenVla final : public Policy {
  DinoV2 dino_;  // observation rate
  Siglip siglip_;
  int d_patch_;
  Linear projector_up_, projector_mid_, projector_down_;
  Decoder lm_;  // observation rate and step rate

 public:
  static Keys published();

  explicit OpenVla(const Scope& s)
      : dino_(s / "dino"),
        siglip_(s / "siglip", kTimmSiglip, false),
        d_patch_(dino_.d_model() + siglip_.d_model()),
        projector_up_(s / "projector_up", d_patch_, 4 * d_patch_, Bias::yes),
        projector_mid_(s / "projector_mid", 4 * d_patch_, (s / "lm").dim("d_model"), Bias::yes),
        projector_down_(s / "projector_down", (s / "lm").dim("d_model"), (s / "lm").dim("d_model"), Bias::yes),
        lm_(s / "lm", kLlama, DecoderOutput::logits) {
    s.require(siglip_.n_position() == dino_.n_patch(), "siglip.image_size", "as many patches as dino has",
              std::to_string(siglip_.n_position()));
  }

  Status check(const InputShape& shape) const override {
    VLA_CHECK(dino_.check(shape.width, shape.height));
    VLA_CHECK(siglip_.check(shape.width, shape.height));
    if (shape.n_text < 2)
      return Error{Code::bad_observation, "instruction", "two tokens or more, the first before the image",
                   std::to_string(shape.n_text)};
    return check_prefix(shape.n_view, dino_.n_patch(), shape.n_text);
  }

  void prefix(Graph& g, const PrefixInputs& in, Cache& cache) const override {
    const Tensor text = lm_.embed(g, in.tokens);
    const int n_text = static_cast<int>(text.dim(1));
    const std::vector<Tensor> parts = {slice_tokens(g, text, 0, 1), image(g, in.images),
                                       slice_tokens(g, text, 1, n_text - 1)};
    const Tensor x = g.name("prefix", concat_tokens(g, parts));
    lm_.prefill(g, x, causal_mask(g, 0, static_cast<int>(x.dim(1))), cache);
  }

  Tensor decode(Graph& g, Tensor token, Tensor k, int n_token, Cache& cache) const override {
    return lm_.next(g, lm_.embed(g, token), k, n_token, cache);
  }

 private:
  /// images [side, side, 3, n_view] -> [d_model, n_patch * n_view]. What the towers subtract from pixels, and divide
  /// them by, is part of their first products.
  Tensor image(Graph& g, Tensor images) const {
    const Tensor patches = concat_features(g, dino_(g, images), siglip_(g, images));
    const Tensor hidden = activate(g, projector_up_(g, patches), Activation::gelu_erf);
    const Tensor mid = activate(g, projector_mid_(g, hidden), Activation::gelu_erf);
    const Tensor tokens = flatten_views(g, projector_down_(g, mid));
    g.end_stage("vision");
    return tokens;
  }
};

/// openvla/openvla-7b: 7.5 B parameters. Source: openvla prismatic/extern/hf/configuration_prismatic.py, timm
/// vit_large_patch14_reg4_dinov2 and vit_so400m_patch14_siglip_224.
Keys OpenVla::published() {
  // clang-format off
  return Keys({
      {"policy.d_state", 0}, {"policy.d_action", 7}, {"policy.horizon", 1},
      {"dino.d_model", 1024}, {"dino.n_layer", 23}, {"dino.n_head", 16}, {"dino.d_ff", 4096},
      {"dino.image_size", 224}, {"dino.patch_size", 14}, {"dino.n_register", 4}, {"dino.norm_eps", 1e-6},
      {"siglip.d_model", 1152}, {"siglip.n_layer", 26}, {"siglip.n_head", 16}, {"siglip.d_ff", 4304},
      {"siglip.image_size", 224}, {"siglip.patch_size", 14}, {"siglip.norm_eps", 1e-6},
      {"siglip.position_rule", "row_major"},
      {"lm.d_model", 4096}, {"lm.n_layer", 32}, {"lm.n_head", 32}, {"lm.n_head_kv", 32}, {"lm.d_head", 128},
      {"lm.d_ff", 11008}, {"lm.n_vocab", 32064}, {"lm.norm_eps", 1e-6}, {"lm.rope_base", 10000.0},
      {"solver.kind", "greedy"}, {"solver.steps", 7}, {"solver.noise", "none"}, {"solver.stop_token", 2}});
  // clang-format on
}

}  // namespace

PolicyEntry openvla_policy() { return policy_entry<OpenVla>("openvla"); }

}  // namespace vla
