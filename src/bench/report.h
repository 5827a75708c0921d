// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "bench/machine.h"
#include "bench/rounds.h"

namespace vla::bench {

/// The subject and the conditions of a measurement: two reports with the same ones may be compared.
struct Conditions {
  std::string policy, weights, source;  // architecture, dtype, where the bundle's weights come from
  int n_view = 0, width = 0, height = 0, n_text = 0, n_step = 0, n_thread = 0;
  std::string kernels, device;
  bool on_cpu() const { return device.starts_with("cpu"); }
};

/// One line of the report: a stage, or `network` (the stages that compute on the device), or `total`. Rates and shares
/// are of the median time; shares of the peak compare each round with the peaks beside it: how long its arithmetic
/// would take at those of its products, in floats and in int8, over how long it took.
struct StageRow {
  std::string name;
  double p50 = 0, p90 = 0, min = 0;     // ms
  Work work;                            // zero for the host's stages
  double flop_rate = 0, byte_rate = 0;  // per second
  double share_of_peak = 0;             // of the best round; shares are the CPU's alone
  double share_of_peak_p50 = 0;
  double share_of_bandwidth = 0;
  double floor = 0;  // ms: arithmetic at peak, or weights at bandwidth, whichever is longer

  /// How many times the floor the median is; 0 where there is none.
  double above_floor() const { return floor > 0 ? p50 / floor : 0; }
  /// Operations per byte; 0 where nothing is counted.
  double intensity() const { return work.bytes > 0 ? work.flop / work.bytes : 0; }
};

struct Report {
  Conditions conditions;
  std::string cpu;
  std::string peak_name, int8_peak_name;  // the probes that shares refer to; no second where there are no int8 products
  std::string precision, arithmetic;      // of the large products, for programs and in plain words
  double load = 0;                        // ms, from opening the bundle to being ready
  Roofs before, after;
  MemoryUse predicted;
  ProcessMemory process;
  MemoryBudget budget;
  std::size_t n_cached = 0;  // bytes of the bundle's file that the system keeps
  std::vector<Round> rounds;
  std::vector<StageRow> stages;  // in order of time, then `network` and `total`
  /// Shares of the time that threads worked for the network in the last round before the measured ones; empty without.
  std::vector<std::pair<std::string, double>> shares;
  std::optional<StepFit> fit;

  /// The machine's peak, of a probe by name or of the one that shares refer to: the best that was measured before,
  /// between and after the runs. Operations and bytes per second.
  double peak(const std::string& name) const;
  double peak() const { return peak(peak_name); }
  /// Seconds of a stage's arithmetic at the machine's peaks.
  double arithmetic_time(const Work& work) const;
  /// Whether something else had a part of the machine meanwhile: fewer cores or a lower peak than in most rounds.
  bool is_disturbed(const Round& round) const;
  double bandwidth() const { return std::max(before.bandwidth, after.bandwidth); }
  /// The bend of the roofline: a stage with fewer operations per byte is bound by memory.
  double ridge() const { return peak() / bandwidth(); }
  /// "compute", "memory", or "host" for a stage without counted work: which of its operands or its arithmetic takes
  /// longer at the machine's rates.
  std::string regime(const StageRow& row) const;
  const StageRow* find(const std::string& stage) const;
};

/// Fills `rounds`, `peak_name` and `stages`; the roofs must stand.
void summarize(const Series& series, Report& report);

/// One JSON object on one line.
std::string to_json(const Report& report);
/// For display: a table with its conditions, or the same as Markdown.
std::string to_text(const Report& report);
std::string to_markdown(const Report& report);

}  // namespace vla::bench
