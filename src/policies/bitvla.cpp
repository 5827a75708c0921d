// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// BitVLA: SigLIP and BitNet b1.58 with ternary weights and 8-bit activations. Parallel decoding: after the prompt the
// language model reads a zero embedding for each value of a chunk, with full attention, and an MLP-ResNet turns the
// features at these embeddings into actions in one pass. Reference: BitVLA openvla-oft
// bitvla/model/bitvla_for_action_prediction.py (predict_action)

#include "modules/action/mlp_resnet.h"
#include "modules/language/qwen.h"
#include "modules/language/view_places.h"
#include "modules/token_projector.h"
#include "modules/vision/siglip.h"
#include "nn/compute_tokens.h"
#include "nn/tokens.h"
#include "policies/policy.h"

namespace vla {
namespace {

class BitVla final : public Policy {
  Siglip vision_;  // observation rate
  Qwen lm_;
  Linear connector_up_, connector_down_;
  TokenProjector state_;
  ViewPlaces places_;
  MlpResNet head_;  // step rate
  int n_action_token_, d_row_, stop_token_;

 public:
  static Keys published();

  explicit BitVla(const Scope& s)
      : vision_(s / "vision", kTernaryEncoder, false),
        lm_(s / "lm", kBitNet),
        connector_up_(s / "connector_up", vision_.d_model(), lm_.d_model(), Bias::yes),
        connector_down_(s / "connector_down", lm_.d_model(), lm_.d_model(), Bias::yes),
        state_(s, "state", s.dim("d_state"), lm_.d_model()),
        places_(s, vision_.n_position()),
        head_(s / "head", lm_.d_model() * s.dim("d_action", 1024), lm_.d_model(), s.dim("d_action", 1024)),
        n_action_token_(s.dim("d_action", 1024) * s.dim("horizon", 4096)),
        d_row_(lm_.d_model() * s.dim("d_action", 1024)),
        stop_token_(s.index("stop_token", (s / "lm").dim("n_vocab", 1 << 24))) {}

  Status check(const InputShape& shape) const override {
    VLA_CHECK(vision_.check(shape.width, shape.height));
    VLA_CHECK(places_.check(shape.n_view, shape.n_text));
    if (shape.n_text <= state_place())
      return Error{Code::bad_bundle, "processor.recipe.text", "a token behind the views, which the state replaces",
                   "none"};
    return check_prefix(0, 0, shape.n_text + n_action_token_ + 1);  // views are part of the text
  }

  void prefix(Graph& g, const PrefixInputs& in, Cache& cache) const override {
    const Tensor image = connector_down_(
        g, activate(g, connector_up_(g, vision_(g, in.images)), Activation::gelu_erf));  // [d_model, n_patch, n_view]
    g.end_stage("vision");
    const Tensor state = state_(g, in.state);  // [d_model, 1]
    const int n_text = static_cast<int>(in.tokens.dim(0));
    const Tensor prompt = places_.arrange(g, image, n_text, [&](const PromptPiece& piece) {
      if (piece.first != state_place()) return embed(g, in.tokens, piece.first, piece.count);
      if (piece.count == 1) return state;
      return concat_tokens(g, {state, embed(g, in.tokens, piece.first + 1, piece.count - 1)});
    });
    const Tensor actions = full(g, 0.0f, lm_.d_model(), n_action_token_);
    const Tensor stop = lm_.embed(g, constant_ids(g, "stop", {stop_token_}));
    const Tensor y = lm_.bidirectional(g, g.name("prefix", concat_tokens(g, {prompt, actions, stop})));
    // The reference takes the features of each action from the token before it.
    cache.put(g, "action_rows", reshape_width(g, compute_tokens(g, y, n_text - 1, n_action_token_), d_row_));
  }

  Tensor velocity(Graph& g, Tensor /*x_t*/, Tensor /*condition*/, const Cache& cache) const override {
    return head_(g, cache.get(g, "action_rows"));
  }

 private:
  /// Index of the token that the state replaces: the one after the views.
  int state_place() const { return places_.min_tokens(); }
  Tensor embed(Graph& g, Tensor tokens, int first, int count) const {
    return lm_.embed(g, slice_ids(g, tokens, first, count));
  }
};

/// hongyuw/ft-bitvla-bitsiglipL-224px-libero_*-bf16: 2.9 B parameters, two views. Source: BitVLA README.md,
/// transformers configuration_bitnet.py.
Keys BitVla::published() {
  // clang-format off
  return Keys({
      {"policy.d_state", 8}, {"policy.d_action", 7}, {"policy.horizon", 8}, {"policy.max_views", 2},
      {"policy.stop_token", 128001}, {"policy.view_starts", std::vector<std::int64_t>{32, 288}},
      {"vision.d_model", 1152}, {"vision.n_layer", 26}, {"vision.n_head", 16}, {"vision.d_ff", 4304},
      {"vision.image_size", 224}, {"vision.patch_size", 14}, {"vision.norm_eps", 1e-6},
      {"vision.position_rule", "row_major"},
      {"lm.d_model", 2560}, {"lm.n_layer", 30}, {"lm.n_head", 20}, {"lm.n_head_kv", 5}, {"lm.d_head", 128},
      {"lm.d_ff", 6912}, {"lm.n_vocab", 128264}, {"lm.norm_eps", 1e-5}, {"lm.rope_base", 5e5},
      {"head.n_layer", 2}, {"head.norm_eps", 1e-5},
      {"solver.kind", "direct"}, {"solver.steps", 1}, {"solver.noise", "none"}});
  // clang-format on
}

}  // namespace

PolicyEntry bitvla_policy() { return policy_entry<BitVla>("bitvla"); }

}  // namespace vla
