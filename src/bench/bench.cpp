// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "bench/bench.h"

#include <fmt/format.h>

#include <algorithm>

#include "devices/devices.h"
#include "policies/policy.h"

namespace vla::bench {
namespace {

Result<RandomBundle> make_random(const Request& request, const Watcher& watcher) {
  VLA_TRY(const PolicyEntry entry, find_policy(request.arch));
  watcher.tell(fmt::format("filling {} with random weights", request.arch));
  return RandomBundle::make(request.arch, entry.published(), random_sizes(request));
}

Conditions conditions_of(const Engine& engine, const Workload& workload, int n_step) {
  const auto text = [&](const char* key) {
    return *engine.robot().bundle().keys().string(key);
  };  // every bundle has these keys
  return {.policy = text("vla.arch"),
          .weights = text("vla.dtype"),
          .source = text("vla.source.name"),
          .n_view = workload.n_view(),
          .width = workload.width(),
          .height = workload.height(),
          .n_text = workload.n_text(),
          .n_step = n_step,
          .n_thread = engine.device().n_thread(),
          .kernels = engine.kernels(),
          .device = engine.device().name()};
}

/// The request's roofs, or those that it measures, whose memory no peak counts.
Roofs roofs_of(const Request& request, const Device& device, const char* task, const Watcher& watcher) {
  if (request.roofs) return *request.roofs;
  watcher.tell(task);
  const Roofs roofs = measure_roofs(device.n_thread());
  forget_peak_memory();
  return roofs;
}

/// Runs the rounds for every number of solver steps.
Result<std::vector<Series>> run_all(Engine& engine, Workload& workload, const std::vector<int>& steps,
                                    const Request& request, const Watcher& watcher) {
  std::vector<Series> all;
  for (int n_step : steps) {
    if (n_step != engine.robot().solver().n_step) VLA_CHECK(engine.set_steps(n_step));
    watcher.tell(fmt::format("{} solver steps", n_step));
    VLA_TRY(Series series, run_series(engine, workload, request.n_warmup, request.n_round, watcher));
    all.push_back(std::move(series));
  }
  return all;
}

}  // namespace

RandomSizes random_sizes(const Request& request) {
  RandomSizes sizes;
  sizes.n_view = request.sizes.n_view.value_or(sizes.n_view);
  sizes.max_tokens = request.sizes.n_text.value_or(sizes.max_tokens);
  sizes.dtype = request.dtype;
  return sizes;
}

Result<Report> measure(const Request& request, const std::function<Status(const Conditions&)>& accept,
                       const Watcher& watcher) {
  VLA_TRY(const std::unique_ptr<Device> device, open_device(request.n_thread, request.kernels, request.device));
  std::optional<RandomBundle> random;
  if (request.bundle.empty()) {
    VLA_TRY(RandomBundle made, make_random(request, watcher));
    random.emplace(std::move(made));
  }
  Report report;
  report.cpu = cpu_name();
  forget_peak_memory();
  StageClock clock;
  Timing load;
  VLA_TRY(const std::unique_ptr<Engine> engine,
          Engine::load(random ? random->path() : request.bundle, {.n_thread = request.n_thread,
                                                                  .kernels = request.kernels,
                                                                  .device = request.device,
                                                                  .embodiment = request.embodiment,
                                                                  .memory = request.memory}));
  clock.lap(load, "load");
  report.load = load.front().second;

  VLA_TRY(Workload workload, Workload::make(engine->robot().processor(), request.sizes));
  std::vector<int> steps = request.steps;
  if (steps.empty()) steps.push_back(engine->robot().solver().n_step);
  report.conditions = conditions_of(*engine, workload, steps.back());
  report.precision = precision_name(engine->precision()), report.arithmetic = engine->arithmetic();
  VLA_CHECK(accept(report.conditions));
  const std::size_t load_peak = process_memory().peak;
  report.before = roofs_of(request, *device, "measuring what the machine can do", watcher);
  VLA_TRY(const std::vector<Series> all, run_all(*engine, workload, steps, request, watcher));
  report.predicted = engine->memory();
  report.process = process_memory();
  report.process.peak = std::max(report.process.peak, load_peak);
  report.budget = engine->budget(), report.n_cached = engine->robot().bundle().content()->n_cached();
  report.after = roofs_of(request, *device, "measuring what the machine can do now", watcher);
  summarize(all.back(), report);
  if (all.size() > 1) report.fit = fit_steps(all);
  return report;
}

}  // namespace vla::bench
