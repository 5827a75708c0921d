// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Evo-1: InternVL3 prefix (InternViT, the first layers of Qwen2.5), a cross-attention head that pools its tokens into
// one vector, flow matching from noise (t = 0) to actions (t = 1). References: Evo-1 Evo_1/model
// (internvl3_embedder.py, flow_matching.py) and Evo_1/scripts/Evo1_server.py; lerobot src/lerobot/policies/evo1.

#include <fmt/format.h>

#include <algorithm>

#include "modules/action/cross_head.h"
#include "modules/language/qwen.h"
#include "modules/language/view_places.h"
#include "modules/vision/internvit.h"
#include "modules/vision/mlp_connector.h"
#include "nn/attention.h"
#include "nn/tokens.h"
#include "policies/policy.h"

namespace vla {
namespace {

constexpr int kTimes = 1000;  // rows in the reference's time table

class Evo1 final : public Policy {
  /// How the prompt's padding and the image tokens of absent views are treated.
  enum class MaskedRows {
    zero_attention,    // flash-attention: the row attends to nothing else, and the head sees it
    causal_attention,  // other attention: the row sees the rows before it, and the head sees it
    unseen             // the head does not see it
  };
  static constexpr int kAbsent = -1;

  InternVit vision_;  // observation rate
  Qwen lm_;
  MlpConnector connector_;
  Linear state_in_, state_out_;
  CrossHead head_;
  Linear action_in_, action_mix_, action_token_, pool_, velocity_in_, velocity_out_;  // step rate
  Embedding action_position_;
  Embedding time_;  // load rate
  ViewPlaces places_;
  int d_action_, d_robot_, horizon_, n_token_, pad_token_;
  bool in_place_;
  MaskedRows masked_rows_;
  double time_scale_;

 public:
  static Keys published();

  explicit Evo1(const Scope& s)
      : vision_(s / "vision"),
        lm_(s / "lm", kQwen2),
        connector_(s / "connector", vision_.d_model(), lm_.d_model(), vision_.n_side(), vision_.n_side()),
        state_in_(s / "state_in", s.dim("d_state"), (s / "head").dim("d_state_hidden"), Bias::yes),
        state_out_(s / "state_out", (s / "head").dim("d_state_hidden"), lm_.d_model(), Bias::yes),
        head_(s / "head", lm_.d_model()),
        action_in_(s / "action_in", s.dim("d_action"), lm_.d_model(), Bias::yes),
        action_mix_(s / "action_mix", lm_.d_model(), lm_.d_model(), Bias::yes),
        action_token_(s / "action_token", lm_.d_model(), lm_.d_model(), Bias::yes),
        pool_(s / "pool", lm_.d_model() * s.dim("horizon", 4096), lm_.d_model(), Bias::yes),
        velocity_in_(s / "velocity_in", lm_.d_model(), (s / "head").dim("d_hidden"), Bias::yes),
        velocity_out_(s / "velocity_out", (s / "head").dim("d_hidden"), s.dim("d_action") * s.dim("horizon", 4096),
                      Bias::yes),
        action_position_(s / "action_position", lm_.d_model(), s.dim("horizon", 4096)),
        time_(s / "time", lm_.d_model(), kTimes),
        places_(s, connector_.n_token()),
        d_action_(s.dim("d_action")),
        d_robot_(s.dim("d_robot")),
        horizon_(s.dim("horizon", 4096)),
        n_token_(s.dim("n_token", 8192)),
        pad_token_(s.index("pad_token", (s / "lm").dim("n_vocab", 1 << 24))),
        in_place_(s.choice("absent_views", {"last", "in_place"}) == 1),
        masked_rows_(
            static_cast<MaskedRows>(s.choice("masked_rows", {"zero_attention", "causal_attention", "unseen"}))),
        time_scale_(s.precise("time_scale", {1, 1e6})) {
    s.require(places_.min_tokens() <= n_token_, "view_starts", fmt::format("places within {} tokens", n_token_),
              std::to_string(places_.min_tokens()));
    s.require(d_robot_ <= d_action_, "d_robot", fmt::format("at most d_action {}", d_action_),
              std::to_string(d_robot_));
  }

  RealTimeChunking real_time_chunking() const override { return {RealTimeChunking::Kind::guided}; }

  Status check(const InputShape& shape) const override {
    VLA_CHECK(vision_.check(shape.width, shape.height));
    VLA_CHECK(check_views("policy.max_views", shape.n_view, places_.max_views()));
    if (shape.n_text < places_.min_tokens() || shape.n_text > n_token_)
      return Error{Code::bad_bundle, "processor.recipe.text",
                   fmt::format("{} to {} tokens", places_.min_tokens(), n_token_), std::to_string(shape.n_text)};
    return check_prefix(1, n_token_, 1);
  }

  bool depends_on_which_views() const override { return in_place_; }

  Tensor condition(Graph& g, std::span<const SolverTime> times) const override {
    // The reference computes the row of its time table from the time in double precision.
    std::vector<std::int32_t> rows;
    for (const SolverTime& time : times)
      rows.push_back(std::min(kTimes - 1, static_cast<int>(time.exact * time_scale_)));
    return time_(g, constant_ids(g, "time_rows", rows));  // [d_model, n_time]
  }

  void constants(Graph& g, const std::function<Tensor()>& absent_view, Cache& cache) const override {
    if (masked_rows_ == MaskedRows::unseen) return;
    const Tensor image = flatten_views(g, connector_(g, vision_(g, absent_view())));  // [d_model, n_view_token]
    if (masked_rows_ == MaskedRows::causal_attention) return cache.put(g, "absent", image);
    head_.keep(g, lm_.alone(g, concat_tokens(g, {image, pads(g, 1)})), cache);
  }

  void prefix(Graph& g, const PrefixInputs& in, Cache& cache) const override {
    const Tensor image = connector_(g, vision_(g, in.images));  // [d_model, n_view_token, n_view]
    g.end_stage("vision");
    const Rows rows = arrange(g, image, in, cache);
    const Tensor x = g.name("prefix", concat_tokens(g, rows.parts));
    const Tensor context = lm_(g, x, rows.positions, causal_mask(g, rows.seen));  // [d_model, n_row]
    const Tensor state = state_out_(g, activate(g, state_in_(g, in.state), Activation::relu));
    head_.prepare(g, concat_tokens(g, {context, state}), rows.kept, horizon_, cache);
  }

  Tensor velocity(Graph& g, Tensor x_t, Tensor time, const Cache& cache) const override {
    const Tensor action = activate(g, action_in_(g, zero_features_after(g, x_t, d_robot_)), Activation::relu);
    const Tensor placed = add(g, action, action_position_(g, arange(g, horizon_)));  // [d_model, horizon]
    const Tensor token = action_token_(g, activate(g, action_mix_(g, placed), Activation::relu));
    const Tensor pooled = pool_(g, flatten(g, head_(g, token, time, cache)));  // [d_model, 1]
    const Tensor hidden = activate(g, velocity_in_(g, pooled), Activation::relu);
    return reshape_width(g, velocity_out_(g, hidden), d_action_);  // [d_action, horizon]
  }

 private:
  /// The rows that the language model reads, and those that only the head sees.
  struct Rows {
    std::vector<Tensor> parts;  // [d_model, n] each
    std::vector<int> positions;
    std::vector<bool> seen;  // whether later rows see it
    std::vector<CrossHead::Kept> kept;

    void add(Tensor part, int first, bool is_seen) {
      parts.push_back(part);
      for (int i = 0; i < part.dim(1); ++i) positions.push_back(first + i), seen.push_back(is_seen);
    }
  };

  Tensor pads(Graph& g, int count) const {
    const std::vector<std::int32_t> ids(static_cast<std::size_t>(count), pad_token_);
    return lm_.embed(g, constant_ids(g, "pads", ids));
  }

  /// For every slot the index of the present view that fills it, or kAbsent.
  std::vector<int> fill_slots(const PrefixInputs& in) const {
    std::vector<int> slots(static_cast<std::size_t>(places_.max_views()), kAbsent);
    int next = 0;
    const int n_view = static_cast<int>(in.images.dim(3));
    for (int slot = 0; slot < places_.max_views() && next < n_view; ++slot)
      if (!in_place_ || (in.views >> slot & 1) != 0) slots[static_cast<std::size_t>(slot)] = next++;
    return slots;
  }

  /// Tokens keep their positions in the whole prompt, even if others are left out.
  Rows arrange(Graph& g, Tensor image, const PrefixInputs& in, const Cache& cache) const {
    Rows rows;
    int n_absent = 0;
    const int n_text = static_cast<int>(in.tokens.dim(0));
    const std::vector<int> slots = fill_slots(in);
    for (const PromptPiece& piece : places_.pieces(n_text)) {
      const bool is_text = piece.slot == PromptPiece::kText;
      const int view = is_text ? kAbsent : slots[static_cast<std::size_t>(piece.slot)];
      if (is_text)
        rows.add(lm_.embed(g, slice_ids(g, in.tokens, piece.first, piece.count)), piece.first, true);
      else if (view != kAbsent)
        rows.add(one_view(g, image, view), piece.first, true);
      else if (masked_rows_ == MaskedRows::causal_attention)
        rows.add(cache.get(g, "absent"), piece.first, false);
      else
        ++n_absent;
    }
    const int n_pad = n_token_ - n_text;
    if (masked_rows_ == MaskedRows::causal_attention && n_pad > 0) rows.add(pads(g, n_pad), n_text, false);
    if (masked_rows_ == MaskedRows::zero_attention) {
      if (n_absent > 0) rows.kept.push_back({0, places_.n_view_token(), n_absent});
      if (n_pad > 0) rows.kept.push_back({places_.n_view_token(), 1, n_pad});
    }
    return rows;
  }
};

/// MINT-SJTU/Evo1_LIBERO: 775 M parameters. Source: Evo-1 Evo_1/config.py, and config.json of OpenGVLab/InternVL3-1B.
Keys Evo1::published() {
  // clang-format off
  return Keys({
      {"policy.d_state", 24}, {"policy.d_action", 24}, {"policy.horizon", 50}, {"policy.d_robot", 7},
      {"policy.max_views", 3}, {"policy.n_token", 1024}, {"policy.pad_token", 151643},
      {"policy.view_starts", std::vector<std::int64_t>{6, 270, 534}},
      {"policy.masked_rows", "zero_attention"}, {"policy.absent_views", "in_place"}, {"policy.time_scale", 999.0},
      {"vision.d_model", 1024}, {"vision.n_layer", 24}, {"vision.n_head", 16}, {"vision.d_ff", 4096},
      {"vision.image_size", 448}, {"vision.patch_size", 14}, {"vision.norm_eps", 1e-6},
      {"connector.factor", 2}, {"connector.norm_eps", 1e-5},
      {"lm.d_model", 896}, {"lm.n_layer", 14}, {"lm.n_head", 14}, {"lm.n_head_kv", 2}, {"lm.d_head", 64},
      {"lm.d_ff", 4864}, {"lm.n_vocab", 151674}, {"lm.norm_eps", 1e-6}, {"lm.rope_base", 1e6},
      {"head.n_layer", 8}, {"head.n_head", 8}, {"head.d_ff", 3584}, {"head.d_hidden", 1024},
      {"head.d_state_hidden", 1024}, {"head.norm_eps", 1e-5}});
  // clang-format on
}

}  // namespace

PolicyEntry evo1_policy() { return policy_entry<Evo1>("evo1"); }

}  // namespace vla
