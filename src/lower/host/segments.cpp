// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/host/segments.h"

#include <algorithm>

#include "lower/host/weight_stream.h"

namespace vla::lower {
namespace {

/// The last group to release after a segment that reads `now`, if the next one reads `then`; -1: none.
int released(const Groups& now, const Groups& then) {
  const bool goes_on = now.first <= then.first && then.first <= now.last;
  if (!goes_on) return now.last;
  return then.first > now.first ? then.first - 1 : -1;
}

}  // namespace

void Groups::add(int group) {
  if (group < 0) return;
  first = any() ? std::min(first, group) : group, last = std::max(last, group);
}

Result<std::vector<Groups>> find_groups(const MatrixReads& phases, const std::vector<int>& groups) {
  std::vector<Groups> found(phases.size());
  for (std::size_t i = 0; i < phases.size(); ++i) {
    for (const OpMatrices& op : phases[i])
      for (const Param* matrix : op) found[i].add(groups[static_cast<std::size_t>(matrix->id)]);
    if (found[i].last - found[i].first >= WeightStream::kWindows)
      return Error{Code::internal, "memory",
                   "phases that read at most " + std::to_string(WeightStream::kWindows) + " groups of matrices",
                   std::to_string(found[i].last - found[i].first + 1), "please report this"};
  }
  return found;
}

std::vector<Segment> cut_phases(std::span<const Groups> phases, std::size_t begin) {
  std::vector<Segment> segments;  // in the loop the last one reads groups
  const auto go_to = [&](std::size_t next, const Groups& then) {
    const std::size_t end = segments.empty() ? begin : segments.back().end;
    if (!segments.empty()) segments.back().released = released(segments.back().groups, then);
    if (end < next) segments.push_back({end, next});  // phases that read none
  };
  for (std::size_t i = 0; i < phases.size(); ++i) {
    if (!phases[i].any()) continue;
    // A phase whose groups the last segment holds extends it, with the phases between.
    if (segments.empty() || !segments.back().groups.holds(phases[i])) {
      go_to(begin + i, phases[i]);
      segments.push_back({begin + i, begin + i, phases[i]});
    }
    segments.back().end = begin + i + 1;
  }
  go_to(begin + phases.size(), {});
  return segments;
}

}  // namespace vla::lower
