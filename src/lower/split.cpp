// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <map>
#include <set>

#include "lower/host/weight_stream.h"
#include "lower/lowering.h"

namespace vla::lower {
namespace {

/// The group that an operation reads, or -1.
int group_of(const Lowering& l, const Step& step) {
  int group = -1;
  for (const Param* matrix : step.matrices) group = std::max(group, l.group_of(*matrix));
  return group;
}

/// Assigns each group that a phase reads to a part, numbered from `part` on. All groups of a part fit into the windows
/// together.
std::map<int, int> parts_of(const std::set<int>& groups, int part) {
  std::map<int, int> parts;
  int first = groups.empty() ? 0 : *groups.begin();
  for (const int group : groups) {
    if (group - first >= WeightStream::kWindows) first = group, ++part;
    parts[group] = part;
  }
  return parts;
}

}  // namespace

bool share_group(const Lowering& l, const std::vector<const Param*>& matrices) {
  std::set<int> groups;
  for (const Param* matrix : matrices) groups.insert(l.group_of(*matrix));
  groups.erase(-1);
  return groups.size() <= 1;
}

void split(Lowering& l, const std::vector<Step*>& steps) {
  std::vector<std::set<int>> groups(static_cast<std::size_t>(l.n_phase));  // groups that each phase reads
  for (const Step* step : steps)
    if (const int group = group_of(l, *step); group >= 0) groups[static_cast<std::size_t>(step->phase)].insert(group);
  std::vector<std::map<int, int>> parts;  // for each phase, the part of each group
  std::vector<int> first;                 // for each phase, its first part
  int next = 0;
  for (const std::set<int>& of_phase : groups) {
    first.push_back(next);
    parts.push_back(parts_of(of_phase, next));
    next = (of_phase.empty() ? next : parts.back().rbegin()->second) + 1;
  }
  first.push_back(next);
  for (Step* step : steps) {
    const auto phase = static_cast<std::size_t>(step->phase);
    const int group = group_of(l, *step);
    step->phase = group >= 0 ? parts[phase].at(group) : first[phase];
  }
  for (const Step* step : steps)
    for (const ValueId id : step->writes) l.base(id).made = std::max(l.base(id).made, step->phase);
  l.n_prepare = first[static_cast<std::size_t>(l.n_prepare)], l.n_phase = next;
}

}  // namespace vla::lower
