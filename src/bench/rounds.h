// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <string>
#include <vector>

#include "bench/workload.h"
#include "engine/engine.h"

namespace vla::bench {

/// One observation, timed; on the CPU between two short probes of the machine's peak.
struct Round {
  Timing stages;         // ms; "decode" first
  double peak = 0;       // operations per second of all threads, the mean of before and after; 0 on a GPU
  double cores = 0;      // CPU time over wall time: how many cores the round really used
  double int8_peak = 0;  // the same for int8 products; 0 if the network has none

  double total() const;  // ms
};

/// Rounds with one number of solver steps.
struct Series {
  int n_step = 0;
  std::string peak_name, int8_peak_name;  // names of the probes between the rounds
  std::vector<Round> rounds;
  StageWork work;                                     // work of the network's stages
  std::vector<std::pair<std::string, double>> times;  // Device::times of the last warm-up round
};

/// Observes a run: receives its messages, and is called before each round, which it may delay or refuse.
struct Watcher {
  std::function<void(const std::string& line)> tell;
  std::function<Status()> before_round;
};

/// Runs warm-up rounds, then measured rounds: probe, observation, probe, ...; without probes on devices other than the
/// CPU. Errors: those of Engine::act.
Result<Series> run_series(Engine& engine, Workload& workload, int n_warmup, int n_round, const Watcher& watcher);

/// total(T) = prefix + T * step, in ms, fitted by least squares to the network's median times.
struct StepFit {
  double prefix = 0, step = 0;
  double worst = 0;  // largest distance of a median from the line
  std::vector<std::pair<int, double>> points;
};
/// Needs series with two different numbers of steps.
StepFit fit_steps(const std::vector<Series>& series);

/// The q-quantile for q = `share`, linearly interpolated (NumPy's default).
double quantile(std::vector<double> values, double share);
/// Milliseconds of one stage in every round.
std::vector<double> stage_times(const Series& series, const std::string& stage);

}  // namespace vla::bench
