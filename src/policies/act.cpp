// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// ACT: ResNet towers, a transformer encoder over the cells of all views and the robot's state, and a decoder that turns
// one learned query per chunk row into an action. It reads no instruction, draws no noise and runs in one pass.
// Training's style variable is zero at inference, so its encoder is not part of the policy. Reference: lerobot
// src/lerobot/policies/act/modeling_act.py

#include <fmt/format.h>

#include "modules/detr.h"
#include "modules/vision/resnet.h"
#include "nn/embedding.h"
#include "nn/sine_positions.h"
#include "nn/tokens.h"
#include "policies/policy.h"

namespace vla {
namespace {

/// Consecutive views whose frames have one size.
struct ViewRun {
  int width, height, first, count;
};

/// Reads `view_sizes`: width and height of each view's frame, which lies in the upper left corner of an image of the
/// common size. Without the key every frame fills its image, and the result is empty.
std::vector<ViewRun> read_runs(const Scope& s) {
  std::vector<ViewRun> runs;
  if (!s.has("view_sizes")) return runs;
  const std::vector<int> sides = s.integers("view_sizes", {1, 16384});
  s.require(!sides.empty() && sides.size() % 2 == 0, "view_sizes", "two sides of each view",
            std::to_string(sides.size()) + " numbers");
  for (std::size_t i = 0; i + 1 < sides.size(); i += 2) {
    const int width = sides[i], height = sides[i + 1];
    if (runs.empty() || runs.back().width != width || runs.back().height != height)
      runs.push_back({width, height, static_cast<int>(i / 2), 0});
    ++runs.back().count;
  }
  return runs;
}

class Act final : public Policy {
  int d_state_, d_environment_, horizon_;
  int n_token_;  // tokens before the view tokens: style, robot, environment
  DetrFamily family_;
  ResNet vision_;              // observation rate
  std::vector<ViewRun> runs_;  // empty: every frame fills its image
  Linear projector_;
  Embedding position_;
  const Param* style_;
  Linear state_in_;
  std::optional<Linear> environment_in_;
  std::vector<DetrEncoderLayer> encoder_;
  std::optional<LayerNorm> encoder_norm_;
  Embedding query_;  // step rate
  DetrDecoder decoder_;
  LayerNorm decoder_norm_;
  Linear action_out_;

 public:
  static Keys published();

  explicit Act(const Scope& s)
      : d_state_(s.dim("d_robot_state")),
        d_environment_(s.index("d_environment_state", 1 << 16)),
        horizon_(s.dim("horizon", 4096)),
        n_token_(d_environment_ > 0 ? 3 : 2),
        family_(DetrFamily::read(s / "transformer")),
        vision_(s / "vision"),
        runs_(read_runs(s / "vision")),
        projector_(s / "projector", vision_.d_model(), family_.d_model, Bias::yes),
        position_(s / "position", family_.d_model, n_token_),
        style_((s / "style").vector("weight", family_.d_model)),
        state_in_(s / "state_in", d_state_, family_.d_model, Bias::yes),
        query_(s / "query", family_.d_model, horizon_),
        decoder_norm_(s / "decoder" / "norm", family_.d_model, family_.norm_eps),
        action_out_(s / "action_out", family_.d_model, s.dim("d_action"), Bias::yes) {
    s.require(family_.d_model % 4 == 0, "transformer.d_model", "a multiple of 4, for positions in two directions",
              std::to_string(family_.d_model));
    s.require(s.dim("d_state") == d_state_ + d_environment_, "d_state", "the robot's and the environment's state",
              std::to_string(s.dim("d_state")));
    if (d_environment_ > 0) environment_in_.emplace(s / "environment_in", d_environment_, family_.d_model, Bias::yes);
    const int n_encoder = (s / "encoder").n_layer("n_layer"), n_decoder = (s / "decoder").n_layer("n_layer");
    for (int i = 0; i < n_encoder; ++i) encoder_.emplace_back(s / "encoder" / "blk" / i, family_);
    decoder_ = DetrDecoder(s / "decoder", family_, n_decoder);
    if (family_.pre_norm) encoder_norm_.emplace(s / "encoder" / "norm", family_.d_model, family_.norm_eps);
  }

  Status check(const InputShape& shape) const override {
    VLA_CHECK(vision_.check(shape.width, shape.height));
    if (shape.n_text > 0)
      return Error{Code::bad_bundle, "processor.recipe.text", "none, since the network reads no text", "tokenize"};
    if (runs_.empty())
      return check_prefix(shape.n_view, ResNet::n_cell(shape.width) * ResNet::n_cell(shape.height), n_token_);
    int n_cell = 0;
    for (const ViewRun& run : runs_) {
      if (run.width > shape.width || run.height > shape.height)
        return Error{Code::bad_bundle, "vision.view_sizes", fmt::format("at most {} x {}", shape.width, shape.height),
                     fmt::format("{} x {}", run.width, run.height)};
      n_cell += run.count * ResNet::n_cell(run.width) * ResNet::n_cell(run.height);
    }
    if (runs_.back().first + runs_.back().count != shape.n_view)
      return Error{Code::bad_bundle, "vision.view_sizes", fmt::format("sizes of {} views", shape.n_view),
                   std::to_string(runs_.back().first + runs_.back().count)};
    return check_prefix(1, n_cell, n_token_);
  }

  /// Queries start at zero, so the first layer's self-attention is the same for every observation.
  void constants(Graph& g, const std::function<Tensor()>& /*absent_view*/, Cache& cache) const override {
    const Tensor zero = full(g, 0.0f, family_.d_model, horizon_);
    decoder_.constants(g, zero, queries(g), cache);
  }

  void prefix(Graph& g, const PrefixInputs& in, Cache& cache) const override {
    std::vector<Tensor> places = {position_.forward(g, arange(g, n_token_))}, views;
    for (const Tensor& images : of_one_size(g, in.images)) {
      const Tensor map = vision_(g, images);  // [512, n_column, n_row, n_view]
      views.push_back(cells(g, projector_(g, map)));
      place(g, map, places);
    }
    g.end_stage("vision");
    std::vector<Tensor> tokens = {g.parameter(style_), state_in_(g, slice(g, in.state, 0, 0, d_state_))};
    if (environment_in_) tokens.push_back((*environment_in_)(g, slice(g, in.state, 0, d_state_, d_environment_)));
    tokens.insert(tokens.end(), views.begin(), views.end());
    Tensor x = g.name("prefix", concat_tokens(g, tokens));
    const Tensor position = concat_tokens(g, places);
    for (const DetrEncoderLayer& layer : encoder_) x = layer(g, x, position);
    if (encoder_norm_) x = (*encoder_norm_)(g, x);
    decoder_.prefix(g, x, position, cache);
  }

  Tensor velocity(Graph& g, Tensor /*x_t*/, Tensor /*condition*/, const Cache& cache) const override {
    return action_out_(g, decoder_norm_(g, decoder_(g, queries(g), cache)));  // [d_action, horizon]
  }

 private:
  Tensor queries(Graph& g) const { return query_.forward(g, arange(g, horizon_)); }
  /// Every cell of a feature map as a token: [d_model, n_column, n_row, n_view] -> [d_model, n].
  static Tensor cells(Graph& g, Tensor map) {
    return g.add(op::Reshape{}, {map}, {map.dim(0), map.dim(1) * map.dim(2) * map.dim(3), 1, 1});
  }
  /// The frames of each run: images [width, height, 3, n_view] -> [width, height, 3, count] of the run's size.
  std::vector<Tensor> of_one_size(Graph& g, Tensor images) const {
    if (runs_.empty()) return {images};
    std::vector<Tensor> parts;
    for (const ViewRun& run : runs_) {
      const Tensor views = slice(g, images, 3, run.first, run.count);
      parts.push_back(slice(g, slice(g, views, 0, 0, run.width), 1, 0, run.height));
    }
    return parts;
  }
  /// Appends the positions of a map's cells. Views of one size have the same positions.
  void place(Graph& g, Tensor map, std::vector<Tensor>& places) const {
    const Tensor of_cells =
        sine_positions(g, static_cast<int>(map.dim(1)), static_cast<int>(map.dim(2)), family_.d_model);
    places.insert(places.end(), static_cast<std::size_t>(map.dim(3)), of_cells);
  }
};

/// The published size for ALOHA: two cameras of 640 x 480, 52 M parameters. Source: lerobot
/// policies/act/configuration_act.py.
Keys Act::published() {
  // clang-format off
  return Keys({
      {"policy.d_state", 14}, {"policy.d_robot_state", 14}, {"policy.d_environment_state", 0},
      {"policy.d_action", 14}, {"policy.horizon", 100},
      {"vision.n_block", std::vector<std::int64_t>{2, 2, 2, 2}},
      {"vision.image_width", 640}, {"vision.image_height", 480},
      {"transformer.d_model", 512}, {"transformer.n_head", 8}, {"transformer.d_ff", 3200},
      {"transformer.activation", "relu"}, {"transformer.norm", "after"}, {"transformer.norm_eps", 1e-5},
      {"encoder.n_layer", 4}, {"decoder.n_layer", 1},
      {"solver.kind", "direct"}, {"solver.steps", 1}, {"solver.noise", "none"}});
  // clang-format on
}

}  // namespace

PolicyEntry act_policy() { return policy_entry<Act>("act"); }

}  // namespace vla
