// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// X-VLA: Florence-2's DaViT over the views, BART's encoder over the first view and the instruction, and a transformer
// over rows of actions, the encoder's output, the other views, and the domain's learned prompts. It predicts actions,
// not a velocity, from a mixture of noise and its last prediction. Each domain has its own action encoder, decoder and
// prompts. Reference: lerobot policies/xvla/modeling_xvla.py (XVLAModel), soft_transformer.py.

#include <fmt/format.h>

#include <algorithm>
#include <optional>

#include "modules/encoder_block.h"
#include "modules/language/bart.h"
#include "modules/timestep_embedding.h"
#include "modules/vision/davit.h"
#include "nn/compute_tokens.h"
#include "policies/policy.h"

namespace vla {
namespace {

class XVla final : public Policy {
  int d_state_, horizon_, n_view_, n_token_, pad_token_;
  std::vector<int> grippers_;
  Davit vision_;  // observation rate
  int d_vision_, n_cell_position_;
  Embedding column_, row_;
  const Param* temporal_;
  BartEncoder lm_;
  Linear projector_;
  LayerNorm projector_norm_;
  int d_model_, n_prompt_, d_time_, n_position_;
  float norm_eps_;
  Linear vlm_in_, aux_in_;
  Embedding position_;
  std::optional<Embedding> prompt_;
  Linear action_in_;  // step rate
  std::vector<EncoderBlock> blocks_;
  LayerNorm norm_;
  Linear action_out_;

 public:
  static Keys published();

  explicit XVla(const Scope& s)
      : d_state_(s.index("d_state", 1 << 16)),
        horizon_(s.dim("horizon", 4096)),
        n_view_(s.dim("n_view", 32)),
        n_token_(s.index("n_token", 4096)),
        pad_token_(s.index("pad_token", (s / "lm").dim("n_vocab", 1 << 24))),
        grippers_(s.integers("grippers", {0, 65535})),
        vision_(s / "vision"),
        d_vision_(vision_.d_model()),
        n_cell_position_((s / "vision").dim("n_position", 4096)),
        column_(s / "column", d_vision_ - d_vision_ / 2, n_cell_position_),
        row_(s / "row", d_vision_ / 2, n_cell_position_),
        temporal_((s / "temporal").vector("weight", d_vision_)),
        lm_(s / "lm"),
        projector_(s / "projector", d_vision_, lm_.d_model(), Bias::no),
        projector_norm_(s / "projector" / "norm", lm_.d_model(), (s / "lm").number("norm_eps", kNormEps)),
        d_model_((s / "transformer").dim("d_model")),
        n_prompt_((s / "transformer").index("n_prompt", 4096)),
        d_time_((s / "transformer").dim("d_time", 4096)),
        n_position_((s / "transformer").dim("n_position")),
        norm_eps_((s / "transformer").number("norm_eps", kNormEps)),
        vlm_in_(s / "vlm_in", lm_.d_model(), d_model_, Bias::yes),
        aux_in_(s / "aux_in", lm_.d_model(), d_model_, Bias::yes),
        position_(s / "position", d_model_, n_position_),
        action_in_(s / "action_in", s.dim("d_action") + d_state_ + d_time_, d_model_, Bias::yes),
        norm_(s / "transformer" / "norm", d_model_, norm_eps_),
        action_out_(s / "action_out", d_model_, s.dim("d_action"), Bias::yes) {
    const Scope t = s / "transformer";
    const int n_layer = t.n_layer("n_layer"), n_head = t.dim("n_head", 1024), d_ff = t.dim("d_ff");
    t.require(d_model_ % n_head == 0, "n_head", fmt::format("a divisor of d_model {}", d_model_),
              std::to_string(n_head));
    if (n_prompt_ > 0) prompt_.emplace(s / "prompt", d_model_, n_prompt_);
    for (int i = 0; i < n_layer; ++i) blocks_.emplace_back(t / "blk" / i, d_model_, n_head, d_ff, norm_eps_);
    for (const int gripper : grippers_)
      s.require(gripper < s.dim("d_action") && (d_state_ == 0 || gripper < d_state_), "grippers",
                "columns of actions and state", std::to_string(gripper));
    const int n_side = std::max(vision_.n_column(), vision_.n_row());
    (s / "vision")
        .require(n_side <= n_cell_position_, "n_position",
                 fmt::format("{} or more, one for each row and column of cells", n_side),
                 std::to_string(n_cell_position_));
  }

  Status check(const InputShape& shape) const override {
    VLA_CHECK(vision_.check(shape.width, shape.height));
    VLA_CHECK(check_views("policy.n_view", shape.n_view, n_view_));
    const int n_text = std::max(shape.n_text, n_token_), n_seen = horizon_ + n_view_ * n_image() + n_text;
    VLA_CHECK(lm_.check(n_image() + n_text));
    if (n_seen > n_position_)
      return Error{Code::bad_bundle, "transformer.n_position", fmt::format("{} or more, one for each token", n_seen),
                   std::to_string(n_position_)};
    return check_prefix(n_view_, n_image(), n_text + horizon_);
  }

  Tensor condition(Graph& g, std::span<const SolverTime> times) const override {
    return wave_embedding(g, times, d_time_, TimeWaves::slow_cosines);
  }

  void constants(Graph& g, const std::function<Tensor()>& /*absent_view*/, Cache& cache) const override {
    vision_.keep(g, cache);
    std::vector<std::int32_t> columns, rows;
    for (int i = 0; i < n_cell(); ++i)
      columns.push_back(i % vision_.n_column()), rows.push_back(i / vision_.n_column());
    const Tensor place = concat_features(g, column_(g, constant_ids(g, "columns of cells", columns)),
                                         row_(g, constant_ids(g, "rows of cells", rows)));
    cache.put(g, "cells", add(g, place, g.parameter(temporal_)));
    if (prompt_) cache.put(g, prompt_->path(), prompt_->forward(g, arange(g, n_prompt_)));
  }

  void prefix(Graph& g, const PrefixInputs& in, Cache& cache) const override {
    const Tensor image = image_tokens(g, vision_(g, in.images, cache), cache);  // [d_lm, n_image, n_view]
    g.end_stage("vision");
    const Tensor x = g.name("prefix", concat_tokens(g, {one_view(g, image, 0), text_tokens(g, in.tokens)}));
    const Tensor seen = vlm_in_(g, lm_(g, x));
    std::vector<Tensor> all = {seen};
    if (n_view_ > 1) all.push_back(other_views(g, image));
    const Tensor context = concat_tokens(g, all);
    const std::int64_t n = context.dim(1);
    const Tensor position = position_.forward(g, arange(g, horizon_ + static_cast<int>(n)));
    cache.put(g, "context", add(g, context, slice_tokens(g, position, horizon_, static_cast<int>(n))));
    cache.put(g, "action_position", slice_tokens(g, position, 0, horizon_));
    if (d_state_ > 0) cache.put(g, "state_seen", without_grippers(g, in.state));
  }

  Tensor velocity(Graph& g, Tensor x_t, Tensor condition, const Cache& cache) const override {
    std::vector<Tensor> parts = {without_grippers(g, x_t)};
    if (d_state_ > 0) parts.push_back(repeat_like(g, cache.get(g, "state_seen"), x_t));
    parts.push_back(repeat_like(g, condition, x_t));
    const Tensor rows = add(g, action_in_(g, concat(g, parts, 0)), cache.get(g, "action_position"));
    std::vector<Tensor> tokens = {rows, cache.get(g, "context")};
    if (prompt_) tokens.push_back(cache.get(g, prompt_->path()));
    Tensor x = concat_tokens(g, tokens);
    for (const EncoderBlock& block : blocks_) x = block(g, x);
    return action_out_(g, norm_(g, compute_tokens(g, x, 0, horizon_)));  // [d_action, horizon]
  }

 private:
  int n_cell() const { return vision_.n_column() * vision_.n_row(); }
  /// The tokens of a view: their mean, then its cells.
  int n_image() const { return n_cell() + 1; }

  /// Source: transformers modeling_florence2.py Florence2MultiModalProjector.
  Tensor image_tokens(Graph& g, Tensor map, const Cache& cache) const {
    const Tensor cells = g.add(op::Reshape{}, {map}, {d_vision_, n_cell(), map.dim(3), 1});
    const Tensor placed = add(g, cells, cache.get(g, "cells"));
    return projector_norm_(g, projector_(g, concat_tokens(g, {mean(g, placed), placed})));
  }

  /// The mean of each view's tokens: a query of zeros attends to keys of zeros, so all values weigh the same. [d, n,
  /// n_view] -> [d, 1, n_view].
  Tensor mean(Graph& g, Tensor x) const {
    const Shape keys = {x.dim(0) / vision_.n_head(), vision_.n_head(), x.dim(1), x.dim(2)};
    const auto zeros = [&](std::int64_t n_token) {
      Tensor one = full(g, 0.0f, keys[0], 1);
      return g.add(op::Repeat{}, {one}, {keys[0], keys[1], n_token, keys[3]});
    };
    const Tensor values = g.add(op::Reshape{}, {x}, keys);
    return attention(g, zeros(1), {{zeros(x.dim(1)), values}}, {});
  }

  /// The reference does not mask padding: tokens attend to it as to words (XVLAModel.forward_vlm).
  Tensor text_tokens(Graph& g, Tensor ids) const {
    const int n_pad = n_token_ - static_cast<int>(ids.dim(0));
    const Tensor words = lm_.token().forward(g, ids);
    if (n_pad <= 0) return words;
    const std::vector<std::int32_t> pads(static_cast<std::size_t>(n_pad), pad_token_);
    return concat_tokens(g, {words, lm_.token().forward(g, constant_ids(g, fmt::format("padding/{}", n_pad), pads))});
  }

  /// All views but the first. Absent views come last, whichever they are, as zeros.
  Tensor other_views(Graph& g, Tensor image) const {
    const int n_other = static_cast<int>(image.dim(2)) - 1, n_absent = n_view_ - 1 - n_other;
    std::vector<Tensor> tokens;
    if (n_other > 0) tokens.push_back(flatten_views(g, slice(g, image, 2, 1, n_other)));
    if (n_absent > 0) tokens.push_back(full(g, 0.0f, lm_.d_model(), std::int64_t{n_absent} * n_image()));
    return aux_in_(g, concat_tokens(g, tokens));
  }

  /// Sets the gripper columns to zero: the network predicts them but does not read them. Source: action_hub.py,
  /// preprocess.
  Tensor without_grippers(Graph& g, Tensor x) const {
    if (grippers_.empty()) return x;
    const std::int64_t d = x.dim(0);
    const Tensor seen = g.constant(fmt::format("without grippers/{}", d), {d, 1, 1, 1}, [&] {
      std::vector<float> values(static_cast<std::size_t>(d), 1.0f);
      for (const int gripper : grippers_) values[static_cast<std::size_t>(gripper)] = 0.0f;
      return values;
    });
    return multiply(g, x, seen);
  }
};

/// The published size with three views: 0.9 B parameters of one domain. Sources: lerobot configuration_xvla.py and the
/// config of lerobot/xvla-base, whose backbone is Florence-2 large.
Keys XVla::published() {
  using Sizes = std::vector<std::int64_t>;
  // clang-format off
  return Keys({
      {"policy.d_state", 20}, {"policy.d_action", 20}, {"policy.horizon", 30}, {"policy.n_view", 3},
      {"policy.n_token", 50}, {"policy.pad_token", 1}, {"policy.grippers", Sizes{9, 19}},
      {"vision.d_model", Sizes{256, 512, 1024, 2048}}, {"vision.n_layer", Sizes{1, 1, 9, 1}},
      {"vision.n_head", Sizes{8, 16, 32, 64}}, {"vision.n_group", Sizes{8, 16, 32, 64}},
      {"vision.d_ff", Sizes{1024, 2048, 4096, 8192}}, {"vision.patch_size", Sizes{7, 3, 3, 3}},
      {"vision.patch_stride", Sizes{4, 2, 2, 2}}, {"vision.pre_norm", Sizes{0, 1, 1, 1}}, {"vision.window", 12},
      {"vision.image_width", 224}, {"vision.image_height", 224}, {"vision.n_position", 50}, {"vision.norm_eps", 1e-5},
      {"lm.d_model", 1024}, {"lm.n_layer", 12}, {"lm.n_head", 16}, {"lm.d_ff", 4096}, {"lm.n_vocab", 51289},
      {"lm.n_position", 4096}, {"lm.norm_eps", 1e-5},
      {"transformer.d_model", 1024}, {"transformer.n_layer", 24}, {"transformer.n_head", 16},
      {"transformer.d_ff", 4096}, {"transformer.d_time", 32}, {"transformer.n_prompt", 32},
      {"transformer.n_position", 512}, {"transformer.norm_eps", 1e-5},
      {"solver.kind", "renoise"}, {"solver.steps", 10}, {"solver.noise", "normal"}});
  // clang-format on
}

}  // namespace

PolicyEntry xvla_policy() { return policy_entry<XVla>("xvla"); }

}  // namespace vla
