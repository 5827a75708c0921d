// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "bench/bench.h"

namespace vla::bench {

/// The resources of a machine and its current load.
struct Machine {
  std::string cpu;
  int n_core = 0;                    // cores that this process may use
  std::vector<std::string> kernels;  // names for --kernels, best last
  Roofs roofs;                       // peak of all these cores
  std::size_t free_memory = 0;       // bytes that a process can allocate within its control group's limit
  std::string governor;              // frequency governor of the first core; empty if unknown
  double load = 0;                   // load average of the last minute
};

/// Measures for a second or two; the machine should be idle. Errors: device.
Result<Machine> examine_machine();

/// A stage of the network: predicted and measured.
struct StageCheck {
  std::string name;
  double predicted = 0, measured = 0;  // ms; 0: no prediction for this device
};

/// A policy on this machine. Times are medians of the rounds, in milliseconds.
struct Checkup {
  Report report;                   // with all cores
  std::vector<StageCheck> stages;  // stages of the network, then "network"
  double host = 0;                 // work of the host: images, text, actions
  double total = 0;
  double cores = 0;                  // cores that the rounds really used
  double one_thread = 0;             // total on one thread; 0 if not measured
  int horizon = 0;                   // rows of a chunk
  double rate_hz = 0;                // rows per second; 0 if the bundle does not state it
  double predicted_int8 = 0;         // time of the network with large matrices as int8 codes; 0 if not predicted
  std::size_t predicted_memory = 0;  // bytes

  double predicted() const { return stages.back().predicted; }
  /// Whether int8 saves enough time to be worth its error.
  bool gains_by_int8() const { return predicted_int8 > 0 && predicted_int8 < 0.9 * predicted(); }
  /// The time with the faster number of threads: small networks are faster on one thread.
  double best() const { return one_thread > 0 ? std::min(one_thread, total) : total; }
  /// Rows that the robot executes while the next chunk is computed, which is the shortest replan interval.
  int replan_rows() const;
  /// Whether a chunk lasts until the next one arrives. True if no rate is stated.
  bool holds_rate() const { return rate_hz == 0 || replan_rows() <= horizon; }
};

/// Predicts from one phase of each kind (Engine::predict), also with int8 codes instead of floats, then loads the
/// bundle and measures a few acts, also on one thread if an act takes less than a quarter of a second. Errors:
/// out_of_memory, before loading, if the policy would not fit; those of `measure`.
Result<Checkup> examine_policy(Request request, const Machine& machine, const Watcher& watcher);

}  // namespace vla::bench
