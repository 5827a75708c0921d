// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// OpenVLA: patches of DINOv2 and SigLIP, and a Llama 2 that answers one token for each number of an action. Reference:
// openvla prismatic/extern/hf/modeling_prismatic.py (PrismaticForConditionalGeneration.forward,
// OpenVLAForActionPrediction.predict_action)

#include "modules/language/decoder.h"
#include "modules/vision/prismatic.h"
#include "nn/tokens.h"
#include "policies/policy.h"

namespace vla {
namespace {

constexpr DecoderFamily kLlama = {Activation::silu, RotaryAngle::product};

class OpenVla final : public Policy {
  PrismaticVision vision_;  // observation rate
  Decoder lm_;              // observation rate and step rate

 public:
  static Keys published();

  explicit OpenVla(const Scope& s) : vision_(s), lm_(s / "lm", kLlama, DecoderOutput::logits) {}

  Status check(const InputShape& shape) const override {
    VLA_CHECK(vision_.check(shape.width, shape.height, shape.n_text));
    return check_prefix(shape.n_view, vision_.n_patch(), shape.n_text);
  }

  void prefix(Graph& g, const PrefixInputs& in, Cache& cache) const override {
    const Tensor text = lm_.embed(g, in.tokens);
    const int n_text = static_cast<int>(text.dim(1));
    const std::vector<Tensor> parts = {slice_tokens(g, text, 0, 1), vision_(g, in.images),
                                       slice_tokens(g, text, 1, n_text - 1)};
    const Tensor x = g.name("prefix", concat_tokens(g, parts));
    lm_.prefill(g, x, causal_mask(g, 0, static_cast<int>(x.dim(1))), cache);
  }

  Tensor decode(Graph& g, Tensor token, Tensor k, int n_token, Cache& cache) const override {
    return lm_.next(g, lm_.embed(g, token), k, n_token, cache);
  }
};

/// openvla/openvla-7b: 7.5 B parameters.
Keys OpenVla::published() {
  // clang-format off
  return prismatic_published({
      {"policy.d_state", 0}, {"policy.d_action", 7}, {"policy.horizon", 1},
      {"solver.kind", "greedy"}, {"solver.steps", 7}, {"solver.noise", "none"}, {"solver.stop_token", 2}});
  // clang-format on
}

}  // namespace

PolicyEntry openvla_policy() { return policy_entry<OpenVla>("openvla"); }

}  // namespace vla
