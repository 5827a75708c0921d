// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "bench/report.h"

#include <algorithm>
#include <nlohmann/json.hpp>

namespace vla::bench {
namespace {

using Json =
    nlohmann::basic_json<nlohmann::ordered_map, std::vector, std::string, bool, std::int64_t, std::uint64_t, float>;

double median_of(const std::vector<Round>& rounds, double Round::*value) {
  std::vector<double> values;
  for (const Round& round : rounds) values.push_back(round.*value);
  return quantile(values, 0.5);
}

/// Seconds that the arithmetic takes at these rates.
double time_at(const Work& work, double peak, double int8_peak) {
  return (work.flop - work.int8) / peak + work.int8 / (int8_peak > 0 ? int8_peak : peak);
}

/// One row from the times and work of every round.
StageRow make_row(const std::string& name, const std::vector<double>& times, const Work& work, const Report& report) {
  StageRow row{
      .name = name, .p50 = quantile(times, 0.5), .p90 = quantile(times, 0.9), .min = quantile(times, 0), .work = work};
  if (row.p50 <= 0) return row;
  row.flop_rate = work.flop / (1e-3 * row.p50);
  row.byte_rate = work.bytes / (1e-3 * row.p50);
  if (!report.conditions.on_cpu()) return row;  // the probes measure the CPU only
  // A disturbed probe would overstate its round's share, so every peak counts at least as the median.
  const double min_peak = median_of(report.rounds, &Round::peak),
               min_int8_peak = median_of(report.rounds, &Round::int8_peak);
  std::vector<double> shares;
  for (std::size_t i = 0; i < times.size(); ++i) {
    const Round& round = report.rounds[i];
    const double best = time_at(work, std::max(round.peak, min_peak), std::max(round.int8_peak, min_int8_peak));
    shares.push_back(best / (1e-3 * times[i]));
  }
  row.share_of_peak = quantile(shares, 1);
  row.share_of_peak_p50 = quantile(shares, 0.5);
  row.share_of_bandwidth = row.byte_rate / report.bandwidth();
  row.floor = 1e3 * std::max(report.arithmetic_time(work), work.weights / report.bandwidth());
  return row;
}

void add_to(std::vector<double>& sums, const std::vector<double>& values) {
  for (std::size_t i = 0; i < sums.size(); ++i) sums[i] += values[i];
}

Json stage_json(const StageRow& row, const Report& report) {
  Json json = {{"p50_ms", row.p50}, {"p90_ms", row.p90}, {"min_ms", row.min}, {"regime", report.regime(row)}};
  if (row.work.bytes == 0) return json;
  json["gflop"] = 1e-9 * row.work.flop;
  json["gbytes"] = 1e-9 * row.work.bytes;
  json["intensity"] = row.intensity();
  json["gflops"] = 1e-9 * row.flop_rate;
  json["gbytes_per_s"] = 1e-9 * row.byte_rate;
  json["share_of_peak"] = row.share_of_peak;
  json["share_of_peak_p50"] = row.share_of_peak_p50;
  json["share_of_bandwidth"] = row.share_of_bandwidth;
  json["floor_ms"] = row.floor;
  json["above_floor"] = row.above_floor();
  return json;
}

Json peaks_json(const Report& report) {
  Json peaks = Json::array();
  for (std::size_t i = 0; i < report.before.peaks.size(); ++i) {
    const Roofs::Peak &before = report.before.peaks[i], &after = report.after.peaks[i];
    peaks.push_back({{"name", before.name},
                     {"one_thread_gflops", {1e-9 * before.one, 1e-9 * after.one}},
                     {"all_threads_gflops", {1e-9 * before.all, 1e-9 * after.all}}});
  }
  return peaks;
}

Json rounds_json(const Report& report) {
  Json rounds = Json::array();
  for (const Round& round : report.rounds) {
    Json json = {{"total_ms", round.total()}, {"cores", round.cores}, {"disturbed", report.is_disturbed(round)}};
    if (round.peak > 0) json["peak_gflops"] = 1e-9 * round.peak;
    if (round.int8_peak > 0) json["int8_peak_gops"] = 1e-9 * round.int8_peak;
    for (const auto& [stage, ms] : round.stages) json["stages"][stage] = ms;
    rounds.push_back(std::move(json));
  }
  return rounds;
}

}  // namespace

double Report::peak(const std::string& name) const {
  double best = std::max(before.peak(name), after.peak(name));
  for (const Round& round : rounds) {
    if (name == peak_name) best = std::max(best, round.peak);
    if (name == int8_peak_name) best = std::max(best, round.int8_peak);
  }
  return best;
}

double Report::arithmetic_time(const Work& work) const { return time_at(work, peak(), peak(int8_peak_name)); }

bool Report::is_disturbed(const Round& round) const {
  constexpr double kMost = 0.9;
  for (const auto value : {&Round::peak, &Round::int8_peak, &Round::cores})
    if (round.*value < kMost * median_of(rounds, value)) return true;
  return false;
}

std::string Report::regime(const StageRow& row) const {
  if (row.work.flop == 0) return "host";
  if (!conditions.on_cpu()) return "device";
  return arithmetic_time(row.work) >= row.work.bytes / bandwidth() ? "compute" : "memory";
}

const StageRow* Report::find(const std::string& stage) const {
  for (const StageRow& row : stages)
    if (row.name == stage) return &row;
  return nullptr;
}

void summarize(const Series& series, Report& report) {
  report.rounds = series.rounds;
  report.peak_name = series.peak_name, report.int8_peak_name = series.int8_peak_name;
  double counted = 0;
  for (const auto& [kind, seconds] : series.times) counted += seconds;
  for (const auto& [kind, seconds] : series.times)
    if (counted > 0) report.shares.emplace_back(kind, seconds / counted);
  std::vector<double> network(series.rounds.size()), total(series.rounds.size());
  Work all;
  for (const auto& [stage, ms] : series.rounds.front().stages) {
    const std::string& name = stage;
    const auto part =
        std::find_if(series.work.begin(), series.work.end(), [&](const auto& work) { return work.first == name; });
    const std::vector<double> times = stage_times(series, name);
    const Work work = part != series.work.end() ? part->second : Work();
    report.stages.push_back(make_row(name, times, work, report));
    add_to(total, times);
    if (part == series.work.end()) continue;
    add_to(network, times);
    all += work;
  }
  report.stages.push_back(make_row("network", network, all, report));
  report.stages.push_back(make_row("total", total, all, report));
}

std::string to_json(const Report& report) {
  const StageRow& network = *report.find("network");
  const Conditions& c = report.conditions;
  Json stages = Json::object();
  for (const StageRow& row : report.stages) stages[row.name] = stage_json(row, report);
  Json root;
  root["total_ms"] = report.find("total")->p50;
  root["share_of_peak"] = network.share_of_peak;
  root["share_of_peak_p50"] = network.share_of_peak_p50;
  root["peak_gflops"] = 1e-9 * report.peak();
  root["peak_name"] = report.peak_name;
  if (!report.int8_peak_name.empty()) {
    root["int8_peak_gops"] = 1e-9 * report.peak(report.int8_peak_name);
    root["int8_peak_name"] = report.int8_peak_name;
  }
  root["stages"] = std::move(stages);
  for (const auto& [kind, share] : report.shares) root["shares"][kind] = share;
  root["kernels"] = c.kernels;
  root["device"] = c.device;
  root["precision"] = report.precision;
  root["threads"] = c.n_thread;
  root["cpu"] = report.cpu;
  root["conditions"] = {{"policy", c.policy}, {"weights", c.weights}, {"source", c.source}, {"views", c.n_view},
                        {"width", c.width},   {"height", c.height},   {"tokens", c.n_text}, {"steps", c.n_step}};
  root["peaks"] = peaks_json(report);
  root["bandwidth_gbytes_per_s"] = {1e-9 * report.before.bandwidth, 1e-9 * report.after.bandwidth};
  root["ridge"] = report.ridge();
  root["load_ms"] = report.load;
  root["memory_bytes"] = {
      {"predicted", report.predicted.total()}, {"peak", report.process.peak}, {"resident", report.process.now}};
  if (report.budget.size > 0) {
    root["memory_bytes"]["budget"] = report.budget.size;
    root["memory_bytes"]["read_in_every_act"] = report.budget.n_read;
    root["memory_bytes"]["cached"] = report.n_cached;
  }
  if (report.fit) {
    root["fit"] = {{"prefix_ms", report.fit->prefix}, {"step_ms", report.fit->step}, {"worst_ms", report.fit->worst}};
    for (const auto& [n_step, ms] : report.fit->points) root["fit"]["points"].push_back({n_step, ms});
  }
  root["rounds"] = rounds_json(report);
  return root.dump(-1, ' ', false, Json::error_handler_t::replace);
}

}  // namespace vla::bench
