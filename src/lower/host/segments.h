// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include "lower/host/weight_plan.h"

namespace vla::lower {

/// Groups of streamed matrices (weight_stream.h) that phases read: from `first` to `last`, or none.
struct Groups {
  int first = -1, last = -1;

  bool any() const { return first >= 0; }
  bool holds(const Groups& other) const { return first <= other.first && other.last <= last; }
  void add(int group);
};

/// Phases from `begin` to before `end`, which run without a stop once their groups are in memory.
struct Segment {
  std::size_t begin, end;
  Groups groups = {};
  int released = -1;  // groups up to this one are needed no more then; -1: none
};

/// The groups that each of some phases reads, where a matrix of id i is in groups[i]. Errors: internal where they do
/// not fit into the windows, which phases that were split (lower/split.cpp) do.
Result<std::vector<Groups>> find_groups(const MatrixReads& phases, const std::vector<int>& groups);

/// Cuts phases, of which the first has the number `begin`, where groups must come and where one is needed no more.
std::vector<Segment> cut_phases(std::span<const Groups> phases, std::size_t begin);

}  // namespace vla::lower
