// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// Diffusion Policy: ResNet towers end in keypoints. The keypoints of all cameras and the state, at the last few
// observation steps, condition a U-Net that predicts the noise of a chunk; a scheduler removes it step by step. It
// reads no instruction. Reference: lerobot src/lerobot/policies/diffusion/modeling_diffusion.py

#include <fmt/format.h>

#include "modules/action/unet.h"
#include "modules/vision/resnet.h"
#include "modules/vision/spatial_softmax.h"
#include "nn/tokens.h"
#include "policies/policy.h"

namespace vla {
namespace {

/// The features of a camera's frames.
class CameraEncoder {
 public:
  /// `keys`: the path of the configuration keys, which all cameras share; `s`: the path of the weights.
  CameraEncoder(const Scope& keys, const Scope& s)
      : n_keypoint_(keys.dim("n_keypoint", 4096)),
        resnet_(keys, s),
        keypoints_(s / "keypoints", resnet_.d_model(), resnet_.n_cell(), n_keypoint_),
        out_(s / "out", 2 * n_keypoint_, 2 * n_keypoint_, Bias::yes) {}
  int d_model() const { return 2 * n_keypoint_; }
  const ResNet& resnet() const { return resnet_; }
  /// images [width, height, 3, n] -> [d_model, n].
  Tensor operator()(Graph& g, Tensor images) const {
    return activate(g, out_(g, keypoints_(g, resnet_(g, images))), Activation::relu);
  }

 private:
  int n_keypoint_;
  ResNet resnet_;
  SpatialSoftmax keypoints_;
  Linear out_;
};

std::vector<CameraEncoder> read_encoders(const Scope& s, int n_camera) {
  std::vector<CameraEncoder> encoders;
  if (n_camera == 0) return encoders;
  const Scope vision = s / "vision";
  if (s.choice("encoders", {"shared", "separate"}) == 0)
    encoders.emplace_back(vision, vision);
  else
    for (int i = 0; i < n_camera; ++i) encoders.emplace_back(vision, vision / i);
  return encoders;
}

/// An observation has `n_moment` moments (observation steps), the oldest first. Views are ordered by camera, then by
/// moment. The state holds the robot's state of all moments, then the environment's.
class Diffusion final : public Policy {
  int d_robot_, d_environment_, n_moment_, n_camera_, horizon_;
  std::vector<CameraEncoder> encoders_;  // observation rate: one for all cameras, or one for each; none without cameras
  Linear time_in_, time_out_;            // load rate
  Unet unet_;                            // step rate

 public:
  static Keys published();

  explicit Diffusion(const Scope& s)
      : d_robot_(s.dim("d_robot_state")),
        d_environment_(s.index("d_environment_state", 1 << 16)),
        n_moment_(s.dim("n_moment", 64)),
        n_camera_(s.index("n_camera", 65)),
        horizon_(s.dim("horizon", 4096)),
        encoders_(read_encoders(s, n_camera_)),
        time_in_(s / "time_in", (s / "unet").dim("d_time"), 4 * (s / "unet").dim("d_time"), Bias::yes),
        time_out_(s / "time_out", 4 * (s / "unet").dim("d_time"), (s / "unet").dim("d_time"), Bias::yes),
        unet_(s / "unet", s.dim("d_action"), d_observation()) {
    s.require(s.dim("d_state") == n_moment_ * (d_robot_ + d_environment_), "d_state",
              fmt::format("the state of {} moments", n_moment_), std::to_string(s.dim("d_state")));
    s.require(horizon_ % unet_.stride() == 0, "horizon", fmt::format("a multiple of {}", unet_.stride()),
              std::to_string(horizon_));
  }

  Status check(const InputShape& shape) const override {
    if (shape.n_text > 0)
      return Error{Code::bad_bundle, "processor.recipe.text", "none, since the network reads no text", "tokenize"};
    if (shape.n_view != n_camera_ * n_moment_)
      return Error{Code::bad_bundle, "observation.views",
                   fmt::format("{} views, of {} cameras at {} moments", n_camera_ * n_moment_, n_camera_, n_moment_),
                   std::to_string(shape.n_view)};
    if (n_camera_ == 0) return {};
    VLA_CHECK(encoders_.front().resnet().check(shape.width, shape.height));
    return check_prefix(shape.n_view, ResNet::n_cell(shape.width) * ResNet::n_cell(shape.height), 1);
  }

  Tensor condition(Graph& g, std::span<const SolverTime> times) const override {
    const Tensor waves = wave_embedding(g, times, unet_.d_time(), TimeWaves::sines_to_last);
    const Tensor time = time_out_(g, activate(g, time_in_(g, waves), Activation::mish));
    return unet_.condition(g, activate(g, time, Activation::mish));
  }

  void prefix(Graph& g, const PrefixInputs& in, Cache& cache) const override {
    std::vector<Tensor> features = {of_moments(g, in.state, 0, d_robot_)};  // [d, n_moment]
    for (const Tensor& camera : of_cameras(g, in.images)) features.push_back(camera);
    if (d_environment_ > 0) features.push_back(of_moments(g, in.state, n_moment_ * d_robot_, d_environment_));
    const Tensor observation = g.name("prefix", flatten(g, concat(g, features, 0)));
    unet_.prefix(g, activate(g, observation, Activation::mish), cache);
  }

  Tensor velocity(Graph& g, Tensor x_t, Tensor condition, const Cache& cache) const override {
    return unet_(g, x_t, condition, cache);
  }

 private:
  int d_observation() const {
    const int d_camera = n_camera_ > 0 ? encoders_.front().d_model() : 0;
    return n_moment_ * (d_robot_ + d_environment_ + n_camera_ * d_camera);
  }
  /// The features of each camera: [d_model, n_moment].
  std::vector<Tensor> of_cameras(Graph& g, Tensor images) const {
    std::vector<Tensor> features;
    if (n_camera_ == 0) return features;
    const Tensor shared = encoders_.size() == 1 ? encoders_.front()(g, images) : Tensor();
    for (int camera = 0; camera < n_camera_; ++camera) {
      const int first = camera * n_moment_;
      const auto own = [&] {
        return encoders_[static_cast<std::size_t>(camera)](g, slice(g, images, 3, first, n_moment_));
      };
      features.push_back(shared ? slice_tokens(g, shared, first, n_moment_) : own());
    }
    g.end_stage("vision");
    return features;
  }
  /// The part of the state that begins at `first` and has `d` numbers per moment: [d, n_moment].
  Tensor of_moments(Graph& g, Tensor state, int first, int d) const {
    return reshape(g, slice_features(g, state, first, n_moment_ * d), {d, n_moment_, 1, 1});
  }
};

/// The published size for PushT: one camera at two moments, 263 M parameters. Source: the checkpoint
/// lerobot/diffusion_pusht.
Keys Diffusion::published() {
  // clang-format off
  return Keys({
      {"policy.d_state", 4}, {"policy.d_robot_state", 2}, {"policy.d_environment_state", 0},
      {"policy.n_moment", 2}, {"policy.n_camera", 1}, {"policy.encoders", "shared"},
      {"policy.d_action", 2}, {"policy.horizon", 16},
      {"vision.n_block", std::vector<std::int64_t>{2, 2, 2, 2}}, {"vision.n_keypoint", 32},
      {"vision.group_width", 16}, {"vision.norm_eps", 1e-5},
      {"vision.image_width", 84}, {"vision.image_height", 84},
      {"unet.widths", std::vector<std::int64_t>{512, 1024, 2048}}, {"unet.kernel_size", 5}, {"unet.n_group", 8},
      {"unet.norm_eps", 1e-5}, {"unet.film", "scale_shift"}, {"unet.d_time", 128},
      {"solver.kind", "ddpm"}, {"solver.steps", 100}, {"solver.noise", "normal"}, {"solver.n_train_step", 100},
      {"solver.beta_schedule", "squaredcos_cap_v2"}, {"solver.beta_start", 0.0001}, {"solver.beta_end", 0.02},
      {"solver.predicts", "noise"}, {"solver.clip", 1.0}});
  // clang-format on
}

}  // namespace

PolicyEntry diffusion_policy() { return policy_entry<Diffusion>("diffusion"); }

}  // namespace vla
