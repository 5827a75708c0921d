// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cpu/weight_plan.h"

#include <algorithm>
#include <set>

namespace vla::lower {
namespace {

using Group = std::vector<const Param*>;

class Planner {
 public:
  Planner(const CpuWeights& weights, const CpuProgram& prefix, const CpuProgram& step) : weights_(weights) {
    for (const MatrixUses& phase : step.uses())
      for (const MatrixUse& use : phase) resident_.insert(use.matrix);
    group_phases(prefix);
  }

  /// The plan that streams least of those that fit.
  WeightPlan plan(std::size_t size) const {
    WeightPlan plan;
    plan.smallest = memory(groups_);
    if (weights_.size() <= size || plan.smallest == weights_.size()) return plan;
    plan.window = window_;
    for (std::size_t n = WeightStream::kWindows + 1; n <= groups_.size(); ++n) {
      plan.streamed = spread(n);
      if (memory(plan.streamed) <= size) break;
    }
    for (const Group& group : plan.streamed)
      for (const Param* matrix : group) plan.n_read += matrix->source->data.size();
    return plan;
  }

 private:
  /// Phases that follow each other, as many to a group as the largest of them has room for.
  void group_phases(const CpuProgram& prefix) {
    std::vector<Group> phases;
    std::set<const Param*> seen = resident_;
    for (std::size_t i = prefix.n_prepare(); i < prefix.uses().size(); ++i) {
      Group& phase = phases.emplace_back();
      for (const MatrixUse& use : prefix.uses()[i])
        if (seen.insert(use.matrix).second) phase.push_back(use.matrix);
      window_ = std::max(window_, size(phase));
    }
    for (const Group& phase : phases) {
      if (phase.empty()) continue;
      if (groups_.empty() || size(groups_.back()) + size(phase) > window_) groups_.emplace_back();
      groups_.back().insert(groups_.back().end(), phase.begin(), phase.end());
    }
  }

  /// n of the groups.
  std::vector<Group> spread(std::size_t n) const {
    std::vector<Group> some;
    for (std::size_t i = 0; i < n; ++i) some.push_back(groups_[i * groups_.size() / n]);
    return some;
  }

  std::size_t size(const Group& group) const {
    std::size_t bytes = 0;
    for (const Param* matrix : group) bytes += weights_.size_of(*matrix);
    return bytes;
  }
  /// Bytes of all parameters, where these groups are streamed if that saves something.
  std::size_t memory(const std::vector<Group>& streamed) const {
    std::size_t bytes = weights_.size() + WeightStream::kWindows * window_;
    for (const Group& group : streamed) bytes -= size(group);
    return std::min(bytes, weights_.size());
  }

  const CpuWeights& weights_;
  std::set<const Param*> resident_;
  std::vector<Group> groups_;
  std::size_t window_ = 0;
};

}  // namespace

WeightPlan plan_streams(const CpuWeights& weights, const CpuProgram& prefix, const CpuProgram& step, std::size_t size) {
  return Planner(weights, prefix, step).plan(size);
}

}  // namespace vla::lower
