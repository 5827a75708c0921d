// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <utility>
#include <vector>

#include "base/clock.h"

namespace vla::serve {

/// Connections that came together, told by when they came: these times are cut where the gap between two of them is a
/// second or more, at the widest where there are many. A flood that is to be of a robot's generation has to leave as
/// many gaps as wide as that between the robot and itself.
class Generations {
 public:
  static constexpr std::size_t kMax = 8;

  explicit Generations(std::vector<Clock::time_point> times) {
    std::sort(times.begin(), times.end());
    std::vector<std::pair<Clock::duration, Clock::time_point>> gaps;  // and what came after
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
  std::vector<Clock::time_point> starts_;  // of all but the oldest
};

}  // namespace vla::serve
