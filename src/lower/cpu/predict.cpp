// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Predicts how long a program takes on this machine. One phase of each kind is timed, in the program's order, and
// counted as often as it occurs: in a network of equal blocks, one block is timed. The weights are zeros and come from
// a cache, so the time to read them from memory is added.
#include <algorithm>
#include <chrono>
#include <limits>
#include <vector>

#include "kernels/probe/probe.h"
#include "lower/cpu/cpu_program.h"

namespace vla::lower {
namespace {

using Clock = std::chrono::steady_clock;
using Seconds = std::chrono::duration<double>;

// Runs of the chosen phases, after one run that touches the memory for the first time.
constexpr int kMinRuns = 3, kMaxRuns = 50;
constexpr double kWanted = 0.2;         // seconds; after kMinRuns, runs continue until this time has passed
constexpr double kBandwidthTime = 0.1;  // seconds

}  // namespace

/// Takes the fastest of several runs, to exclude the time of other programs. Times the second phase of each kind, since
/// the first may follow something that occurs only once.
std::vector<double> CpuProgram::seconds_of_kinds() const {
  std::vector<std::size_t> chosen;  // by kind, the phase that is timed
  std::vector<int> n_met;
  for (std::size_t i = 0; i < counted_.size(); ++i) {
    const auto kind = static_cast<std::size_t>(counted_[i].kind);
    if (kind == chosen.size()) chosen.push_back(i), n_met.push_back(0);
    if (++n_met[kind] == 2) chosen[kind] = i;
  }
  std::ranges::sort(chosen);
  std::vector<Clock::time_point> ended(chosen.size());
  std::vector<kernels::Phase> phases;
  for (std::size_t i = 0; i < chosen.size(); ++i) phases.push_back({phases_[chosen[i]].tasks, &ended[i]});
  std::vector<double> fastest(chosen.size(), std::numeric_limits<double>::infinity());
  const auto begun = Clock::now();
  for (int run = 0; run <= kMinRuns || (run <= kMaxRuns && Seconds(Clock::now() - begun).count() < kWanted); ++run) {
    auto start = Clock::now();
    executor_->run(phases);
    for (std::size_t i = 0; i < chosen.size(); start = ended[i++]) {
      double& seconds = fastest[static_cast<std::size_t>(counted_[chosen[i]].kind)];
      if (run > 0) seconds = std::min(seconds, Seconds(ended[i] - start).count());
    }
  }
  return fastest;
}

std::vector<Program::Prediction> CpuProgram::predictions() const {
  if (bound_ != weights_->version) bind();
  const std::vector<double> kinds = seconds_of_kinds();
  const double bandwidth = kernels::measure_read_bandwidth(executor_->n_thread(), kBandwidthTime);
  std::vector<Prediction> all(work_.size() + 1);
  for (const Counted& phase : counted_) {
    const double computed = kinds[static_cast<std::size_t>(phase.kind)];
    const double read = bandwidth > 0 ? phase.weights / bandwidth : 0;
    all[phase.entry] += {.seconds = computed + read, .products = computed, .bytes = read, .n_launch = 1};
  }
  return all;
}

}  // namespace vla::lower
