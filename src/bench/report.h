// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "bench/machine.h"
#include "bench/rounds.h"

namespace vla::bench {

/// What was measured, and under which conditions. Two reports with the same subject and conditions can be compared.
struct Conditions {
  std::string policy, weights, source;  // architecture, dtype, source of the weights
  int n_view = 0, width = 0, height = 0, n_text = 0, n_step = 0, n_thread = 0;
  std::string kernels, device;
  bool on_cpu() const { return device.starts_with("cpu"); }
};

/// One row of the report: a stage, `network` (the stages on the device), or `total`. Rates use the median time. A
/// round's share of the peak is the time that its arithmetic takes at the peaks measured before and after it (float and
/// int8), divided by its measured time.
struct StageRow {
  std::string name;
  double p50 = 0, p90 = 0, min = 0;     // ms
  Work work;                            // zero for host stages
  double flop_rate = 0, byte_rate = 0;  // per second
  double share_of_peak = 0;             // in the best round; shares exist for the CPU only
  double share_of_peak_p50 = 0;
  double share_of_bandwidth = 0;
  double floor = 0;  // ms: the longer of arithmetic at peak and weights at bandwidth

  /// The median over the floor; 0 without a floor.
  double above_floor() const { return floor > 0 ? p50 / floor : 0; }
  /// Operations per byte; 0 if nothing is counted.
  double intensity() const { return work.bytes > 0 ? work.flop / work.bytes : 0; }
};

struct Report {
  Conditions conditions;
  std::string cpu;
  // names of the probes that shares refer to; the second is empty without int8 products
  std::string peak_name, int8_peak_name;
  std::string precision, arithmetic;  // precision of the large products: an identifier, a description
  double load = 0;                    // ms from opening the bundle until it is ready
  Roofs before, after;
  MemoryUse predicted;
  ProcessMemory process;
  MemoryBudget budget;
  std::size_t n_cached = 0;  // bytes of the bundle's file in the page cache
  std::vector<Round> rounds;
  std::vector<StageRow> stages;  // in time order, then `network` and `total`
  /// Shares of the network's thread time by kind of operation, from the last warm-up round; empty if not counted.
  std::vector<std::pair<std::string, double>> shares;
  std::optional<StepFit> fit;

  /// The machine's peak for a probe by name, or for the one that shares refer to: the best measured before, between and
  /// after the rounds. Operations per second.
  double peak(const std::string& name) const;
  double peak() const { return peak(peak_name); }
  /// Seconds that a stage's arithmetic takes at the machine's peaks.
  double arithmetic_time(const Work& work) const;
  /// Whether another program used a part of the machine: fewer cores or a lower peak than in most rounds.
  bool is_disturbed(const Round& round) const;
  double bandwidth() const { return std::max(before.bandwidth, after.bandwidth); }
  /// The ridge point of the roofline: a stage with fewer operations per byte is memory-bound.
  double ridge() const { return peak() / bandwidth(); }
  /// "compute" or "memory", whichever takes longer at the machine's rates; "host" for a stage without counted work.
  std::string regime(const StageRow& row) const;
  const StageRow* find(const std::string& stage) const;
};

/// Fills `rounds`, `peak_name` and `stages`; the machine's peaks must be set.
void summarize(const Series& series, Report& report);

/// One JSON object on one line.
std::string to_json(const Report& report);
/// A table with its conditions: as text for display, or as Markdown.
std::string to_text(const Report& report);
std::string to_markdown(const Report& report);

}  // namespace vla::bench
