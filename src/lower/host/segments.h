// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include "lower/host/weight_plan.h"

namespace vla::lower {

/// The groups of streamed matrices (weight_stream.h) that phases read: `first` to `last`, or none.
struct Groups {
  int first = -1, last = -1;

  bool any() const { return first >= 0; }
  bool holds(const Groups& other) const { return first <= other.first && other.last <= last; }
  void add(int group);
};

/// The phases [begin, end), which run without a pause once their groups are in memory.
struct Segment {
  std::size_t begin, end;
  Groups groups = {};
  int released = -1;  // groups up to this one are released after the segment; -1: none
};

/// Finds the groups that each phase reads; groups[i] is the group of the matrix with Param::id i, or -1. Errors:
/// internal if the groups of a phase do not fit into the windows; lower/split.cpp splits phases so that they fit.
Result<std::vector<Groups>> find_groups(const MatrixReads& phases, const std::vector<int>& groups);

/// Cuts phases into segments where groups must be loaded or can be released. `begin`: the number of the first phase.
std::vector<Segment> cut_phases(std::span<const Groups> phases, std::size_t begin);

}  // namespace vla::lower
