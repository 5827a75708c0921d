// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "bench/rounds.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "bench/machine.h"
#include "kernels/probe/probe.h"

namespace vla::bench {
namespace {

constexpr double kProbeSeconds = 0.03;

Result<Round> run_round(Engine& engine, Workload& workload) {
  Round round;
  const double cpu_before = cpu_seconds();
  StageClock clock;
  VLA_CHECK(workload.decode());
  clock.lap(round.stages, "decode");
  VLA_TRY(const ActionChunk chunk, engine.act(workload.observation(), std::uint64_t{0}));
  round.cores = cpu_seconds() - cpu_before;
  round.stages.insert(round.stages.end(), chunk.timing.begin(), chunk.timing.end());
  round.cores /= 1e-3 * round.total();
  return round;
}

/// The network's time in a round, without the host's work before and after.
double network_time(const Round& round, const StageWork& work) {
  double time = 0;
  for (const auto& [stage, ms] : round.stages)
    for (const auto& part : work)
      if (part.first == stage) time += ms;
  return time;
}

}  // namespace

double Round::total() const {
  double sum = 0;
  for (const auto& stage : stages) sum += stage.second;
  return sum;
}

Result<Series> run_series(Engine& engine, Workload& workload, int n_warmup, int n_round, const Watcher& watcher) {
  const Features use = engine.device().features();
  const kernels::PeakProbe& probe = kernels::peak_probe_of(use);
  // No probes with a GPU: it would lower its clock meanwhile, and its times are not compared with the CPU's peak.
  const bool has_peaks = engine.device().is_host();
  const kernels::PeakProbe* int8 =
      has_peaks && engine.has_int8_products() ? kernels::int8_probe_of(use, engine.has_ternary()) : nullptr;
  const auto measure_peaks = [&](Round& round) {  // called before and after a round
    if (!has_peaks) return;
    const int n_thread = engine.device().n_thread();
    round.peak += kernels::measure_peak(probe, n_thread, kProbeSeconds) / 2;
    if (int8 != nullptr) round.int8_peak += kernels::measure_peak(*int8, n_thread, kProbeSeconds) / 2;
  };
  Series series{engine.robot().solver().n_step, probe.name, int8 != nullptr ? int8->name : "", {}, {}, {}};
  for (int i = 0; i < n_warmup; ++i) {
    VLA_CHECK(watcher.before_round());
    engine.device().count_times(true);
    VLA_TRY(const Round round, run_round(engine, workload));
    engine.device().count_times(false);
    series.times = engine.device().times();
    watcher.tell(fmt::format("warm-up {}/{}: {:.1f} ms", i + 1, n_warmup, round.total()));
  }
  for (int i = 0; i < n_round; ++i) {
    VLA_CHECK(watcher.before_round());
    Round peaks;
    measure_peaks(peaks);
    VLA_TRY(Round round, run_round(engine, workload));
    measure_peaks(peaks);
    round.peak = peaks.peak, round.int8_peak = peaks.int8_peak;
    watcher.tell(fmt::format("round {}/{}: {:.1f} ms on {:.2f} cores{}{}", i + 1, n_round, round.total(), round.cores,
                             has_peaks ? fmt::format(", peak {:.1f} GFLOP/s", 1e-9 * round.peak) : "",
                             int8 != nullptr ? fmt::format(", int8 {:.1f} GOP/s", 1e-9 * round.int8_peak) : ""));
    series.rounds.push_back(std::move(round));
  }
  series.work = engine.work();
  return series;
}

StepFit fit_steps(const std::vector<Series>& series) {
  StepFit fit;
  double mean_x = 0, mean_y = 0, xx = 0, xy = 0;
  for (const Series& one : series) {
    std::vector<double> times;
    for (const Round& round : one.rounds) times.push_back(network_time(round, one.work));
    fit.points.emplace_back(one.n_step, quantile(times, 0.5));
    mean_x += one.n_step / static_cast<double>(series.size());
    mean_y += fit.points.back().second / static_cast<double>(series.size());
  }
  for (const auto& [x, y] : fit.points) xx += (x - mean_x) * (x - mean_x), xy += (x - mean_x) * (y - mean_y);
  fit.step = xy / xx;
  fit.prefix = mean_y - fit.step * mean_x;
  for (const auto& [x, y] : fit.points) fit.worst = std::max(fit.worst, std::abs(y - fit.prefix - fit.step * x));
  return fit;
}

double quantile(std::vector<double> values, double share) {
  if (values.empty()) return 0;
  std::sort(values.begin(), values.end());
  const double place = share * static_cast<double>(values.size() - 1);
  const auto low = static_cast<std::size_t>(place), high = std::min(low + 1, values.size() - 1);
  return values[low] + (place - static_cast<double>(low)) * (values[high] - values[low]);
}

std::vector<double> stage_times(const Series& series, const std::string& stage) {
  std::vector<double> times;
  for (const Round& round : series.rounds)
    for (const auto& [name, ms] : round.stages)
      if (name == stage) times.push_back(ms);
  return times;
}

}  // namespace vla::bench
