// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <map>
#include <memory>

#include "engine/injection.h"
#include "engine/leftover.h"
#include "engine/solver.h"
#include "engine/taps.h"
#include "graph/device.h"
#include "policies/policy.h"

namespace vla {

/// Work by stage, with the stage names of Timing.
using StageWork = std::vector<std::pair<std::string, Work>>;

using StagePredictions = std::vector<std::pair<std::string, Program::Prediction>>;

/// The parts of a robot from which its plans are built.
struct Network {
  const Policy& policy;
  const Solver& solver;
  const Slot* conditions;  // [d, n_step]: values that depend only on time, one column per solver step; or null
  const Cache& constants;  // values that depend only on weights
  int d_action, horizon;
};

/// The context that all plans of an engine share.
struct PlanContext {
  Device& device;
  std::string tap_pattern;
  bool dry;                               // sizes only, nothing is computed
  const std::vector<Tap>* injected = {};  // values to inject; null: none
  std::function<void(const Graph&)> see_graph = {};
  TapVisitor see_tap = {};
};

/// The two programs of one input shape, and the memory that outlives a run: inputs, cache, x. They are built once, then
/// replayed.
class Plan {
 public:
  /// Errors: out_of_memory, internal, bad_observation (an injected value without a place).
  static Result<std::unique_ptr<Plan>> build(const Network& network, const InputShape& shape,
                                             const PlanContext& context);

  /// `ahead`: pixels that Device::send has sent already, or null.
  void set_inputs(std::span<const float> pixels, const Device::Sent* ahead, std::span<const std::int32_t> tokens,
                  std::span<const float> state);
  /// Sets the noise of the act: the start of the first step, then the noise of each step that adds some.
  void set_noise(std::span<const float> noise);
  /// The network's answer: x, or the tokens that were decoded.
  std::vector<float> x() const { return token_ != nullptr ? decoded_ : device_.get(*x_); }
  /// Sets the steering, for a shape with a leftover.
  void set_steering(const Steering& steering);

  /// Runs the prefix, which fills the cache, and appends its taps. Then computes the part of the steps that depends
  /// only on the cache.
  Status run_prefix(std::vector<Tap>& taps);
  /// Whether the act needs step k. Call it after step k - 1, or after the prefix for k = 0. If the policy decodes
  /// tokens, it also takes the next token from the logits. Errors: bad_action for logits that are not finite.
  Result<bool> needs_step(int k);
  /// Runs step k after step k - 1: computes the solver's next x, or the logits that follow the last token.
  Status run_step(int k);

  /// The stages that the policy's prefix names, with the last run's times. Read x first.
  const std::vector<Program::Stage>& prefix_stages() const { return prefix_->stages(); }
  /// When the prefix ended. Read x first.
  Program::Time prefix_ended() const { return prefix_->ended().value_or(prefix_ended_); }
  const Program& prefix() const { return *prefix_; }
  const Program& step() const { return *step_; }

  /// The work of the network for one observation: the prefix, stage by stage, and `n_step` solver steps.
  StageWork work(int n_step) const;

  /// The predicted time of the same; empty if the device predicts nothing (Program::predictions).
  StagePredictions predict(int n_step) const;

  /// Appends the taps that the last step recorded, as `step.<k>.<path>`.
  void collect_step_taps(int k, std::vector<Tap>& taps) const;

  /// Bytes: slots, constants and the programs themselves.
  std::size_t size() const { return slots_.size() + prefix_->size() + step_->size(); }

 private:
  Plan(const Network& network, const InputShape& shape, const PlanContext& context);
  Status lower(const Network& network, const PlanContext& context);
  void record_solver(Graph& step, const Network& network, LowerOptions& changing) const;
  void record_decoder(Graph& step, const Network& network, LowerOptions& changing);
  TapVisitor visitor_of_steps(const TapVisitor& see) const;
  Tensor steered(Graph& step, Tensor x, Tensor k, Tensor velocity) const;

  std::string tap_pattern_;
  Device& device_;
  Slots slots_;
  // The inputs of an act, side by side in the order in which the act sets them, so that one upload sends them all.
  // Images, tokens and state may be null. `x` is null if the policy decodes tokens, `token` if it does not. `noise` is
  // null unless steps read it. The last three are null without a leftover.
  Slot *images_, *tokens_, *state_, *x_, *token_, *k_, *noise_, *target_, *keep_, *pull_;
  Slot* logits_ = nullptr;
  const Solver& solver_;
  std::vector<float> decoded_;      // tokens of this act so far
  std::vector<float> read_logits_;  // the host's copy of the logits
  std::vector<float> no_token_;     // zeros, to clear the slots of appended keys and values before an act
  std::uint64_t views_;
  TextLayout text_;
  Cache cache_;
  Injection injection_;
  int i_step_ = 0;  // the step that runs or ran last
  std::unique_ptr<Program> prefix_, step_;
  Program::Time prefix_ended_;
};

/// The cached plans of all robots of an engine, within one memory limit.
class Plans {
 public:
  explicit Plans(PlanContext context) : context_(std::move(context)) {}

  /// Returns the plan of a shape, building it if needed; all others are evicted first if they exceed the limit.
  /// `network` must outlive it. Errors: those of Plan::build.
  Result<Plan*> for_shape(const Network& network, const InputShape& shape);
  /// Null if there is none.
  const Plan* find(const Network& network, const InputShape& shape) const;
  void clear() { plans_.clear(); }
  /// Bytes of all plans.
  std::size_t size() const;

 private:
  PlanContext context_;
  std::map<std::pair<const Policy*, InputShape>, std::unique_ptr<Plan>> plans_;
};

}  // namespace vla
