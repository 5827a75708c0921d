// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <utility>
#include <vector>

#include "base/clock.h"

namespace vla::serve {

/// Splits connections into at most kMax generations by time of arrival, at the widest gaps of a second or more. A flood
/// can join a robot's generation only if kMax - 1 other gaps are at least as wide as the gap between the robot and the
/// flood.
class Generations {
 public:
  static constexpr std::size_t kMax = 8;

  explicit Generations(std::vector<Clock::time_point> times) {
    std::sort(times.begin(), times.end());
    std::vector<std::pair<Clock::duration, Clock::time_point>> gaps;  // gaps, and the arrival after each
    for (std::size_t i = 1; i < times.size(); ++i)
      if (const auto gap = times[i] - times[i - 1]; gap >= std::chrono::seconds(1)) gaps.emplace_back(gap, times[i]);
    std::sort(gaps.rbegin(), gaps.rend());
    gaps.resize(std::min(gaps.size(), kMax - 1));
    for (const auto& [gap, start] : gaps) starts_.push_back(start);
    std::sort(starts_.begin(), starts_.end());
  }

  std::size_t size() const { return starts_.size() + 1; }
  /// 0 for the oldest.
  std::size_t of(Clock::time_point time) const {
    return static_cast<std::size_t>(std::upper_bound(starts_.begin(), starts_.end(), time) - starts_.begin());
  }

 private:
  std::vector<Clock::time_point> starts_;  // first arrivals of all generations except the oldest
};

}  // namespace vla::serve
