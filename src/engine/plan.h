// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <memory>

#include "engine/solver.h"
#include "engine/taps.h"
#include "policies/policy.h"

namespace vla {

/// Work by stage, under the names that Timing has.
using StageWork = std::vector<std::pair<std::string, Work>>;

/// What every plan is built from and shares.
struct PlanContext {
  const Policy& policy;
  const Weights& weights;
  const Device& device;
  const Solver& solver;
  Tensor conditions;       // [d, n_step]: what depends on the time alone, one column per solver step
  const Cache& constants;  // what depends on the weights alone
  int d_action, horizon;
  std::string tap_pattern;
};

/// The two graphs of one input shape, with the memory that outlives a run: inputs, cache, x. Built once, then only
/// replayed.
class Plan {
 public:
  /// Errors: out_of_memory.
  static Result<std::unique_ptr<Plan>> build(const PlanContext& context, const InputShape& shape,
                                             ComputeMemory& memory);

  void set_inputs(std::span<const float> pixels, std::span<const std::int32_t> tokens, std::span<const float> state);
  void set_x(std::span<const float> x);
  std::vector<float> x() const;

  /// Graph::touch for both graphs.
  void touch() const { prefix_.touch(), step_.touch(); }
  Status run_prefix(const Device& device) { return prefix_.run(device); }
  /// Solver step k: x <- x + dt * velocity(x, t_k).
  Status run_step(const Device& device, int k);

  /// The stages that the policy's prefix names, with the times of the last run.
  const std::deque<Stage>& prefix_stages() const { return prefix_.stages(); }

  /// What the network computes for one observation: the prefix, stage by stage, and `n_step` solver steps.
  StageWork work(int n_step) const;

  /// What the last run recorded; of a step graph the paths are `step.<k>.<path>`.
  void collect_prefix_taps(std::vector<Tap>& taps) const;
  void collect_step_taps(int k, std::vector<Tap>& taps) const;

  std::size_t size() const { return store_.size(); }

 private:
  Plan(const PlanContext& context, const InputShape& shape);
  void build_prefix(const PlanContext& context);
  void build_step(const PlanContext& context);

  std::string tap_pattern_;
  Store store_;
  PrefixInputs in_;
  Tensor x_, k_;
  Cache cache_;
  Graph prefix_, step_;
};

/// The plans that exist. All share one working memory; when a new shape makes it grow, the others are built again.
class Plans {
 public:
  Plans(PlanContext context) : context_(std::move(context)), memory_(context_.device) {}
  Result<Plan*> for_shape(const InputShape& shape);
  /// Has the system back the memory of every plan before the first request.
  void touch() const;
  /// Bytes of inputs, caches and constants of all plans.
  std::size_t size() const;
  std::size_t working_size() const { return memory_.size(); }

 private:
  PlanContext context_;
  ComputeMemory memory_;
  std::map<InputShape, std::unique_ptr<Plan>> plans_;
};

}  // namespace vla
