// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/host/weight_plan.h"

#include <algorithm>
#include <map>
#include <set>
#include <span>

#include "lower/host/weight_stream.h"

namespace vla::lower {
namespace {

using Group = std::vector<const Param*>;

class Planner {
 public:
  explicit Planner(const WeightUse& use) : use_(use) {
    for (const auto& phase : use.step)
      for (const OpMatrices& op : phase) resident_.insert(op.begin(), op.end());
    while (!group_phases()) groups_.clear();
  }

  /// The plan that streams the fewest groups and fits into `size` bytes; all groups if none fits. Streams nothing if
  /// all parameters fit, or if streaming saves no memory.
  WeightPlan plan(std::size_t size) const {
    WeightPlan plan;
    plan.smallest = memory(groups_);
    if (use_.size <= size || plan.smallest == use_.size) return plan;
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
  /// Groups the matrices of consecutive phases; a group is at most as large as the largest phase. If an operation would
  /// read several groups, makes its matrices resident and returns false.
  bool group_phases() {
    std::vector<Group> phases;
    std::set<const Param*> seen = resident_;
    window_ = 0;
    for (const auto& ops : std::span(use_.prefix).subspan(use_.n_prepare)) {
      Group& phase = phases.emplace_back();
      for (const OpMatrices& op : ops)
        for (const Param* matrix : op)
          if (seen.insert(matrix).second) phase.push_back(matrix);
      window_ = std::max(window_, size(phase));
    }
    std::map<const Param*, std::size_t> group_of;
    for (const Group& phase : phases) {
      if (phase.empty()) continue;
      if (groups_.empty() || size(groups_.back()) + size(phase) > window_) groups_.emplace_back();
      groups_.back().insert(groups_.back().end(), phase.begin(), phase.end());
      for (const Param* matrix : phase) group_of[matrix] = groups_.size() - 1;
    }
    const std::size_t n_resident = resident_.size();
    for (const auto& ops : use_.prefix)
      for (const OpMatrices& op : ops)
        if (reads_several(op, group_of)) resident_.insert(op.begin(), op.end());
    return resident_.size() == n_resident;
  }

  static bool reads_several(const OpMatrices& op, const std::map<const Param*, std::size_t>& group_of) {
    std::set<std::size_t> groups;
    for (const Param* matrix : op)
      if (const auto found = group_of.find(matrix); found != group_of.end()) groups.insert(found->second);
    return groups.size() > 1;
  }

  /// Picks n groups, evenly spread.
  std::vector<Group> spread(std::size_t n) const {
    std::vector<Group> some;
    for (std::size_t i = 0; i < n; ++i) some.push_back(groups_[i * groups_.size() / n]);
    return some;
  }

  std::size_t size(const Group& group) const {
    std::size_t bytes = 0;
    for (const Param* matrix : group) bytes += use_.size_of(*matrix);
    return bytes;
  }
  /// Bytes of all parameters if these groups are streamed; at most those without streaming.
  std::size_t memory(const std::vector<Group>& streamed) const {
    std::size_t bytes = use_.size + WeightStream::kWindows * window_;
    for (const Group& group : streamed) bytes -= size(group);
    return std::min(bytes, use_.size);
  }

  const WeightUse& use_;
  std::set<const Param*> resident_;
  std::vector<Group> groups_;
  std::size_t window_ = 0;
};

}  // namespace

WeightPlan plan_streams(const WeightUse& use, std::size_t size) { return Planner(use).plan(size); }

std::vector<int> groups_by_id(const WeightPlan& plan, std::size_t n_param) {
  std::vector<int> groups(n_param, -1);
  for (std::size_t i = 0; i < plan.streamed.size(); ++i)
    for (const Param* matrix : plan.streamed[i]) groups[static_cast<std::size_t>(matrix->id)] = static_cast<int>(i);
  return groups;
}

}  // namespace vla::lower
