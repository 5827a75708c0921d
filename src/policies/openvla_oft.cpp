// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// OpenVLA-OFT: OpenVLA's towers see one to three cameras, and its Llama 2 reads a token for each number of a whole
// chunk, with full attention. An MLP-ResNet turns the features at these tokens into actions in one pass, or into the
// noise that DDIM removes step by step. FiLM lets the instruction modulate the towers. Reference: openvla-oft
// prismatic/extern/hf/modeling_prismatic.py (OpenVLAForActionPrediction.predict_action)

#include "modules/action/mlp_resnet.h"
#include "modules/language/qwen.h"
#include "modules/token_projector.h"
#include "modules/vision/prismatic.h"
#include "nn/compute_tokens.h"
#include "nn/tokens.h"
#include "policies/policy.h"

namespace vla {
namespace {

class OpenVlaOft final : public Policy {
  bool is_modulated_, denoises_;
  int d_action_, n_action_token_, stop_token_;
  Qwen lm_;  // observation rate; step rate with DDIM
  PrismaticVision vision_;
  std::optional<TokenProjector> state_;
  std::optional<TokenProjector> noisy_action_;  // step rate
  MlpResNet head_;

 public:
  static Keys published();

  explicit OpenVlaOft(const Scope& s)
      : is_modulated_(s.choice("film", {"none", "scale_shift"}) == 1),
        denoises_((s / "solver").choice("kind", {"direct", "ddim"}) == 1),
        d_action_(s.dim("d_action", 1024)),
        n_action_token_(d_action_ * s.dim("horizon", 4096)),
        stop_token_(s.index("stop_token", (s / "lm").dim("n_vocab", 1 << 24))),
        lm_(s / "lm", kLlama2),
        vision_(s, is_modulated_ ? lm_.d_model() : 0),
        head_(s / "head", lm_.d_model() * d_action_, lm_.d_model(), d_action_) {
    const int d_state = s.index("d_state", 1 << 16);
    if (d_state > 0) state_.emplace(s, "state", d_state, lm_.d_model());
    if (denoises_) {
      noisy_action_.emplace(s, "noise", 1, lm_.d_model());
      s.require(lm_.d_model() % 2 == 0 && lm_.d_model() >= 4, "lm.d_model",
                "an even width from 4 on, for sines and cosines", std::to_string(lm_.d_model()));
    }
    s.require(lm_.d_model() % lm_.heads().n_head == 0, "lm.n_head", "a divisor of d_model",
              std::to_string(lm_.heads().n_head));
  }

  Status check(const InputShape& shape) const override {
    VLA_CHECK(vision_.check(shape.width, shape.height, shape.n_text));
    return check_prefix(shape.n_view, vision_.n_patch(), shape.n_text + n_action_token_ + 3);
  }

  Tensor condition(Graph& g, std::span<const SolverTime> times) const override {
    return denoises_ ? wave_embedding(g, times, lm_.d_model(), TimeWaves::sines_to_last) : Tensor();
  }

  void prefix(Graph& g, const PrefixInputs& in, Cache& cache) const override {
    const Tensor text = lm_.embed(g, in.tokens);
    const int n_text = static_cast<int>(text.dim(1));
    const Tensor meaning = is_modulated_ ? mean(g, concat_tokens(g, {text, stop(g)})) : Tensor();
    std::vector<Tensor> seen = {slice_tokens(g, text, 0, 1), vision_(g, in.images, meaning)};
    if (state_) seen.push_back((*state_)(g, in.state));
    const Tensor question = slice_tokens(g, text, 1, n_text - 1);
    if (denoises_) {
      cache.put(g, "seen", g.name("prefix", concat_tokens(g, seen)));
      return cache.put(g, "question", question);
    }
    seen.push_back(question);
    cache.put(g, "action_rows", rows(g, seen, full(g, 0.0f, lm_.d_model(), n_action_token_), "prefix"));
  }

  Tensor velocity(Graph& g, Tensor x_t, Tensor condition, const Cache& cache) const override {
    if (!denoises_) return head_(g, cache.get(g, "action_rows"));
    const Tensor noisy = (*noisy_action_)(g, reshape_width(g, x_t, 1));
    return head_(g, rows(g, {cache.get(g, "seen"), condition, cache.get(g, "question")}, noisy, "sequence"));
  }

 private:
  Tensor stop(Graph& g) const { return lm_.embed(g, constant_ids(g, "stop", {stop_token_})); }

  /// The features of the tokens `actions` [d_model, n_action_token] after a prompt: [d_model * d_action, horizon]. The
  /// whole sequence is the tap `name`. The reference takes the features of each action from the token before it.
  Tensor rows(Graph& g, std::vector<Tensor> prompt, Tensor actions, const char* name) const {
    int n_prompt = 0;
    for (const Tensor& part : prompt) n_prompt += static_cast<int>(part.dim(1));
    prompt.insert(prompt.end(), {actions, stop(g)});
    const Tensor y = lm_.bidirectional(g, g.name(name, concat_tokens(g, prompt)));
    return reshape_width(g, compute_tokens(g, y, n_prompt - 1, n_action_token_), lm_.d_model() * d_action_);
  }

  /// The mean of tokens, computed as an attention with a zero query: [d_model, n] -> [d_model, 1].
  Tensor mean(Graph& g, Tensor x) const {
    const Tensor heads = split_heads(g, x, lm_.heads().n_head);
    return attention(g, split_heads(g, full(g, 0.0f, lm_.d_model(), 1), lm_.heads().n_head), {{heads, heads}}, {});
  }
};

/// moojink/openvla-7b-oft-finetuned-libero-*: two cameras, 7.5 B parameters. Source: openvla-oft
/// prismatic/vla/constants.py (LIBERO), prismatic/models/action_heads.py; the rest is OpenVLA's.
Keys OpenVlaOft::published() {
  // clang-format off
  return prismatic_published({
      {"policy.d_state", 8}, {"policy.d_action", 7}, {"policy.horizon", 8}, {"policy.stop_token", 2},
      {"policy.film", "none"},
      {"head.n_layer", 2}, {"head.norm_eps", 1e-5},
      {"solver.kind", "direct"}, {"solver.steps", 1}, {"solver.noise", "none"}});
  // clang-format on
}

}  // namespace

PolicyEntry openvla_oft_policy() { return policy_entry<OpenVlaOft>("openvla_oft"); }

}  // namespace vla
