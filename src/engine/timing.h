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

/// Adds the time since the last call as a named stage.
class StageClock {
 public:
  using Time = std::chrono::steady_clock::time_point;

  void lap(Timing& timing, const std::string& stage) { lap(timing, stage, std::chrono::steady_clock::now()); }
  /// Adds a stage whose end was noted elsewhere.
  void lap(Timing& timing, const std::string& stage, Time end) {
    timing.emplace_back(stage, std::chrono::duration<double, std::milli>(end - last_).count());
    last_ = end;
  }

 private:
  Time last_ = std::chrono::steady_clock::now();
};

}  // namespace vla
