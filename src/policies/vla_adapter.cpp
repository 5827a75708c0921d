// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// VLA-Adapter: OpenVLA's towers, and a Qwen2.5 0.5B that reads action queries after the prompt. Each layer of the head
// attends to the image and query features of one layer of the language model; the last layer returns a whole chunk.
// Reference: VLA-Adapter prismatic/extern/hf/modeling_prismatic.py (OpenVLAForActionPrediction.predict_action,
// _regression_or_discrete_prediction), prismatic/models/{action_heads,projectors}.py

#include <algorithm>

#include "modules/action/bridge_head.h"
#include "modules/language/qwen.h"
#include "modules/token_projector.h"
#include "modules/vision/prismatic.h"
#include "nn/tokens.h"
#include "policies/policy.h"

namespace vla {
namespace {

class VlaAdapter final : public Policy {
  PrismaticVision vision_;  // observation rate
  Qwen lm_;
  TokenProjector state_;
  int n_query_, n_task_;
  Embedding queries_;
  BridgeHead head_;

 public:
  static Keys published();

  explicit VlaAdapter(const Scope& s)
      : vision_(s),
        lm_(s / "lm", kQwen2),
        state_(s, "state", s.dim("d_state"), lm_.d_model()),
        n_query_(s.dim("n_query", 8192)),
        n_task_(s.dim("n_task", 1 << 20)),
        queries_(s / "queries", lm_.d_model(), n_query_),
        head_(s / "head", lm_.d_model(), lm_.n_layer(), s.dim("d_action", 1024), s.dim("horizon", 4096)) {
    s.require(n_query_ > 1, "n_query", "2 or more", std::to_string(n_query_));
  }

  Status check(const InputShape& shape) const override {
    VLA_CHECK(vision_.check(shape.width, shape.height, shape.n_text));
    return check_prefix(shape.n_view, vision_.n_patch(), shape.n_text + n_query_);
  }

  void constants(Graph& g, const std::function<Tensor()>& /*absent_view*/, Cache& cache) const override {
    head_.constants(g, cache);
  }

  void prefix(Graph& g, const PrefixInputs& in, Cache& cache) const override {
    const Tensor image = vision_(g, in.images);  // [d_model, n_image]
    const Tensor text = lm_.embed(g, in.tokens);
    const int n_image = static_cast<int>(image.dim(1)), n_text = static_cast<int>(text.dim(1));
    // The reference's image features begin one row before the image, and its query features one row before the queries.
    // So nothing reads the last query, and since attention is causal, it can be left out.
    const Tensor queries = queries_(g, arange(g, n_query_ - 1));
    const Tensor x =
        g.name("prefix",
               concat_tokens(g, {slice_tokens(g, text, 0, 1), image, slice_tokens(g, text, 1, n_text - 1), queries}));
    const Tensor state = state_(g, in.state);  // [d_model, 1]
    const int n_task = std::min(n_task_, n_image + n_query_);
    Tensor rows = head_.start(g, cache);
    lm_.layers(g, x, [&](int i, Tensor y) {
      const Tensor all =
          concat_tokens(g, {slice_tokens(g, y, 0, n_image), slice_tokens(g, y, n_image + n_text - 1, n_query_)});
      const int n_action = n_image + n_query_ - n_task;
      const Tensor task = slice_tokens(g, all, 0, n_task);
      const Tensor actions = n_action > 0 ? concat_tokens(g, {slice_tokens(g, all, n_task, n_action), state}) : state;
      rows = head_.block(i)(g, rows, actions, task, cache);
    });
    cache.put(g, "rows", rows);
  }

  Tensor velocity(Graph& g, Tensor /*x_t*/, Tensor /*condition*/, const Cache& cache) const override {
    return head_.end(g, cache.get(g, "rows"));
  }
};

/// VLA-Adapter/LIBERO-*-Pro: two views, 1.4 B parameters. Source: VLA-Adapter pretrained_models/configs/config.json,
/// prismatic/vla/constants.py, prismatic/models/action_heads.py.
Keys VlaAdapter::published() {
  // clang-format off
  return prismatic_published({
      {"policy.d_state", 8}, {"policy.d_action", 7}, {"policy.horizon", 8},
      {"policy.n_query", 64}, {"policy.n_task", 512},
      {"lm.d_model", 896}, {"lm.n_layer", 24}, {"lm.n_head", 14}, {"lm.n_head_kv", 2}, {"lm.d_head", 64},
      {"lm.d_ff", 4864}, {"lm.n_vocab", 151936}, {"lm.norm_eps", 1e-6}, {"lm.rope_base", 1e6},
      {"head.version", "pro"}, {"head.n_head", 8}, {"head.norm_eps", 1e-5},
      {"solver.kind", "direct"}, {"solver.steps", 1}, {"solver.noise", "none"}});
  // clang-format on
}

}  // namespace

PolicyEntry vla_adapter_policy() { return policy_entry<VlaAdapter>("vla_adapter"); }

}  // namespace vla
