// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "bench/bench.h"

namespace vla::bench {

/// A machine's resources for a policy, and its load.
struct Machine {
  std::string cpu;
  int n_core = 0;                    // that this process may use
  std::vector<std::string> kernels;  // as --kernels names them, the best last
  Roofs roofs;                       // of all these cores
  std::size_t free_memory = 0;       // bytes that a process could take, under the limit of its group too
  std::string governor;              // of the first core's frequency; empty where the system does not tell
  double load = 0;                   // running or waiting threads of the last minute, on the mean
};

/// Takes a second or two, in which the machine should do nothing else. Errors: device.
Result<Machine> examine_machine();

/// Bytes that a process could take: what the system has available, or less where a control group limits it.
/// `meminfo`, `limit` and `used` are the texts of /proc/meminfo and of the group's two files; empty where there is
/// none.
std::size_t free_memory(const std::string& meminfo, const std::string& limit, const std::string& used);

/// A stage of the network as it should be here, and as it was.
struct StageCheck {
  std::string name;
  double predicted = 0, measured = 0;  // ms; 0: no prediction for this device
};

/// A policy on this machine. Times are milliseconds, medians of the rounds.
struct Checkup {
  Report report;                   // with every core
  std::vector<StageCheck> stages;  // of the network; then "network"
  double host = 0;                 // before and after the network: images, text, actions
  double total = 0;
  double cores = 0;                  // that the rounds had
  double one_thread = 0;             // the total with one thread; 0 where that was not measured
  int horizon = 0;                   // rows of a chunk
  double rate_hz = 0;                // rows a second; 0 where the bundle does not state it
  std::size_t predicted_memory = 0;  // bytes

  /// The fewer threads where they are faster: small networks are.
  double best() const { return one_thread > 0 ? std::min(one_thread, total) : total; }
  /// Rows that the robot executes while the next chunk is computed: it cannot replan more often.
  int replan_rows() const;
  /// Whether a chunk lasts until the next one is there. True where no rate is stated.
  bool holds_rate() const { return rate_hz == 0 || replan_rows() <= horizon; }
};

/// Predicts from one phase of each kind (Engine::predict), loads the bundle and measures a few acts; on one thread
/// too where an act takes less than a quarter of a second. Errors: out_of_memory, before anything is loaded, where it
/// would not fit; those of `measure`.
Result<Checkup> examine_policy(const Request& request, std::size_t free_memory, const Watcher& watcher);

}  // namespace vla::bench
