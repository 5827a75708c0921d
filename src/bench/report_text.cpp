// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>
#include <fmt/ranges.h>

#include "bench/report.h"

namespace vla::bench {
namespace {

constexpr const char* kColumns[] = {"stage",          "p50 ms", "p90 ms",       "min ms",  "floor ms",
                                    "above",          "GFLOP",  "GB",           "FLOP/B",  "GFLOP/s",
                                    "of peak (best)", "GB/s",   "of bandwidth", "bound by"};

std::vector<std::string> cells(const StageRow& row, const Report& report) {
  std::vector<std::string> cells = {row.name, fmt::format("{:.2f}", row.p50), fmt::format("{:.2f}", row.p90),
                                    fmt::format("{:.2f}", row.min)};
  if (row.work.flop == 0) {
    cells.resize(std::size(kColumns));
    cells.back() = "host";
    return cells;
  }
  // The probes measure the CPU only.
  const auto on_cpu = [&](std::string cell) { return report.conditions.on_cpu() ? std::move(cell) : std::string(); };
  for (std::string cell :
       {on_cpu(fmt::format("{:.2f}", row.floor)), on_cpu(fmt::format("{:.2f} x", row.above_floor())),
        fmt::format("{:.3g}", 1e-9 * row.work.flop), fmt::format("{:.3g}", 1e-9 * row.work.bytes),
        fmt::format("{:.1f}", row.intensity()), fmt::format("{:.1f}", 1e-9 * row.flop_rate),
        on_cpu(fmt::format("{:.1f} % ({:.1f} %)", 100 * row.share_of_peak_p50, 100 * row.share_of_peak)),
        fmt::format("{:.1f}", 1e-9 * row.byte_rate), on_cpu(fmt::format("{:.0f} %", 100 * row.share_of_bandwidth)),
        report.regime(row)})
    cells.push_back(std::move(cell));
  return cells;
}

std::vector<std::string> around(const Report& report) {
  const Conditions& c = report.conditions;
  std::vector<std::string> lines = {
      fmt::format("{}, {} weights ({}): {} view{} of {} x {}, {} tokens, {} steps, batch 1", c.policy, c.weights,
                  c.source, c.n_view, c.n_view == 1 ? "" : "s", c.width, c.height, c.n_text, c.n_step),
      fmt::format("{}, {} thread{}, kernels: {}, {}", c.on_cpu() ? report.cpu : c.device + " beside " + report.cpu,
                  c.n_thread, c.n_thread == 1 ? "" : "s", c.kernels, report.arithmetic)};
  for (std::size_t i = 0; i < report.before.peaks.size(); ++i) {
    const Roofs::Peak &before = report.before.peaks[i], &after = report.after.peaks[i];
    lines.push_back(fmt::format(
        "peak {}: {:.1f} G/s before the runs, {:.1f} after; one thread {:.1f}, {:.1f}{}", before.name,
        1e-9 * before.all, 1e-9 * after.all, 1e-9 * before.one, 1e-9 * after.one,
        before.name == report.peak_name || before.name == report.int8_peak_name ? " (what shares refer to)" : ""));
  }
  lines.push_back(
      fmt::format("memory bandwidth: {:.1f} GB/s before the runs, {:.1f} after; compute-bound from {:.1f} FLOP/B",
                  1e-9 * report.before.bandwidth, 1e-9 * report.after.bandwidth, report.ridge()));
  std::vector<double> cores, peaks;
  for (const Round& round : report.rounds) cores.push_back(round.cores), peaks.push_back(1e-9 * round.peak);
  const std::string beside =
      report.conditions.on_cpu()
          ? fmt::format("each beside its own peak ({:.1f} to {:.1f} GFLOP/s)", quantile(peaks, 0), quantile(peaks, 1))
          : "one after the other";
  lines.push_back(fmt::format("measured rounds: {}, {}, on {:.2f} cores (median)", report.rounds.size(), beside,
                              quantile(cores, 0.5)));
  std::vector<std::string> shares;
  for (const auto& [kind, share] : report.shares) shares.push_back(fmt::format("{} {:.1f} %", kind, 100 * share));
  if (!shares.empty()) lines.push_back(fmt::format("time of the threads: {}", fmt::join(shares, ", ")));
  std::vector<std::size_t> disturbed;
  for (std::size_t i = 0; i < report.rounds.size(); ++i)
    if (report.is_disturbed(report.rounds[i])) disturbed.push_back(i + 1);
  if (!disturbed.empty())
    lines.push_back(fmt::format("disturbed: round{} {}, with fewer cores or a lower peak than most: measure again",
                                disturbed.size() == 1 ? "" : "s", fmt::join(disturbed, ", ")));
  lines.push_back(fmt::format("loaded in {:.0f} ms; memory: {:.0f} MB predicted, {:.0f} MB at the most, {:.0f} MB now",
                              report.load, 1e-6 * static_cast<double>(report.predicted.total()),
                              1e-6 * static_cast<double>(report.process.peak),
                              1e-6 * static_cast<double>(report.process.now)));
  if (report.budget.size > 0)
    lines.push_back(
        fmt::format("budget {:.0f} MB: every act reads {:.0f} MB of the file, of which the system keeps {:.0f} MB",
                    1e-6 * static_cast<double>(report.budget.size), 1e-6 * static_cast<double>(report.budget.n_read),
                    1e-6 * static_cast<double>(report.n_cached)));
  if (report.fit) {
    std::vector<std::string> points;
    for (const auto& [n_step, ms] : report.fit->points) points.push_back(fmt::format("{}: {:.1f}", n_step, ms));
    lines.push_back(fmt::format("network over steps: {:.2f} ms + {:.2f} ms a step, within {:.2f} ms ({})",
                                report.fit->prefix, report.fit->step, report.fit->worst, fmt::join(points, ", ")));
  }
  return lines;
}

/// The summary line.
std::string headline(const Report& report) {
  const StageRow* total = report.find("total");
  if (total == nullptr || total->p50 <= 0) return "";
  return fmt::format("{:.{}f} ms an act (median, pixels to actions): {:.3g} chunks a second", total->p50,
                     total->p50 < 100 ? 1 : 0, 1e3 / total->p50);
}

}  // namespace

std::string to_text(const Report& report) {
  std::vector<std::vector<std::string>> table = {{std::begin(kColumns), std::end(kColumns)}};
  for (const StageRow& row : report.stages) table.push_back(cells(row, report));
  std::string text;
  for (const std::string& line : around(report)) text += line + "\n";
  text += "\n";
  for (const auto& row : table)
    for (std::size_t i = 0; i < row.size(); ++i) {
      std::size_t width = 0;
      for (const auto& other : table) width = std::max(width, other[i].size());
      text += i == 0 ? fmt::format("{:<{}}", row[i], width) : fmt::format("  {:>{}}", row[i], width);
      if (i + 1 == row.size()) text += "\n";
    }
  return text + "\n" + headline(report) + "\n";
}

std::string to_markdown(const Report& report) {
  std::string text;
  for (const std::string& line : around(report)) text += "- " + line + "\n";
  text += fmt::format("\n| {} |\n|", fmt::join(kColumns, " | "));
  for (std::size_t i = 0; i < std::size(kColumns); ++i) text += i == 0 ? " --- |" : " ---: |";
  for (const StageRow& row : report.stages) text += fmt::format("\n| {} |", fmt::join(cells(row, report), " | "));
  return text + "\n";
}

}  // namespace vla::bench
