// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <chrono>
#include <string>
#include <utility>
#include <vector>

namespace vla {

/// Milliseconds per stage, in the order in which the stages ran.
using Timing = std::vector<std::pair<std::string, double>>;

/// Cuts the time since the last cut into named stages.
class StageClock {
 public:
  void lap(Timing& timing, const std::string& stage) {
    const auto now = std::chrono::steady_clock::now();
    timing.emplace_back(stage, std::chrono::duration<double, std::milli>(now - last_).count());
    last_ = now;
  }

 private:
  std::chrono::steady_clock::time_point last_ = std::chrono::steady_clock::now();
};

}  // namespace vla
