// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "bench/doctor.h"

#include <fmt/format.h>

#include <cmath>
#include <fstream>

#include "base/process.h"
#include "devices/devices.h"
#include "engine/description.h"
#include "kernels/kernel_set.h"

namespace vla::bench {
namespace {

constexpr double kFewMs = 250;  // a shorter act may be faster on one thread

std::string first_line(const char* path) {
  std::ifstream in(path);
  std::string line;
  std::getline(in, line);
  return line;
}

double median_cores(const Report& report) {
  std::vector<double> cores;
  for (const Round& round : report.rounds) cores.push_back(round.cores);
  return quantile(cores, 0.5);
}

/// Predicted milliseconds of a stage, or of all stages as `network`; 0 without a prediction.
double predicted_ms(const StagePredictions& stages, const std::string& name) {
  double seconds = 0;
  for (const auto& [stage, prediction] : stages)
    if (stage == name || name == "network") seconds += prediction.seconds;
  return 1e3 * seconds;
}

void add_stages(Checkup& checkup, const StagePredictions& predicted) {
  const Report& report = checkup.report;
  for (const StageRow& row : report.stages)
    if (row.work.flop > 0 && row.name != "total")
      checkup.stages.push_back({row.name, predicted_ms(predicted, row.name), row.p50});
  checkup.total = report.find("total")->p50;
  checkup.host = checkup.total - report.find("network")->p50;
}

/// Predicted milliseconds of the network with large matrices as int8 codes; 0 if that is not possible.
double predict_int8(const Request& request) {
  const auto dry = Engine::load(
      request.bundle, {.n_thread = request.n_thread, .kernels = "int8", .dry = true, .embodiment = request.embodiment});
  const auto predicted = dry ? (*dry)->predict() : Result<StagePredictions>(dry.error());
  return predicted ? predicted_ms(*predicted, "network") : 0;
}

}  // namespace

Result<Machine> examine_machine() {
  VLA_TRY(const std::unique_ptr<Device> device, open_device(0, ""));
  Machine machine;
  machine.cpu = cpu_name();
  machine.n_core = device->n_thread();
  for (const KernelSet& set : usable_kernels()) machine.kernels.push_back(name_of(set));
  machine.load = std::strtod(first_line("/proc/loadavg").c_str(), nullptr);
  machine.governor = first_line("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor");
  machine.free_memory = free_memory();
  machine.roofs = measure_roofs(machine.n_core);
  return machine;
}

int Checkup::replan_rows() const { return std::max(1, static_cast<int>(std::ceil(1e-3 * best() * rate_hz))); }

Result<Checkup> examine_policy(Request request, const Machine& machine, const Watcher& watcher) {
  request.roofs = machine.roofs;
  Checkup checkup;
  StagePredictions predicted;
  const bool on_cpu = request.device.empty() || request.device == "cpu";
  bool has_floats = false;
  {  // computes sizes and predictions without weights
    VLA_TRY(const std::unique_ptr<Engine> dry, Engine::load(request.bundle, {.n_thread = request.n_thread,
                                                                             .kernels = request.kernels,
                                                                             .device = request.device,
                                                                             .dry = true,
                                                                             .embodiment = request.embodiment}));
    checkup.predicted_memory = dry->memory().total();
    checkup.horizon = describe(*dry, dry->robot()).horizon;
    checkup.rate_hz = describe(*dry, dry->robot()).rate_hz;
    const std::size_t free_memory = machine.free_memory;
    if (on_cpu && free_memory > 0 && checkup.predicted_memory > free_memory)
      return Error{Code::out_of_memory, request.bundle,
                   fmt::format("{:.1f} GB of free memory", 1e-9 * static_cast<double>(checkup.predicted_memory)),
                   fmt::format("{:.1f} GB", 1e-9 * static_cast<double>(free_memory)),
                   "vla quantize makes a smaller bundle"};
    if (on_cpu) {
      watcher.tell("timing one block of each kind");
      VLA_TRY(predicted, dry->predict());
      has_floats = dry->precision() != Precision::int8;
    }
  }
  if (on_cpu && has_floats) checkup.predicted_int8 = predict_int8(request);
  const auto accept = [](const Conditions&) { return Status(); };
  VLA_TRY(checkup.report, measure(request, accept, watcher));
  checkup.cores = median_cores(checkup.report);
  add_stages(checkup, predicted);
  if (on_cpu && checkup.total < kFewMs && checkup.report.conditions.n_thread > 1) {
    request.n_thread = 1;
    VLA_TRY(const Report report, measure(request, accept, watcher));
    checkup.one_thread = report.find("total")->p50;
  }
  return checkup;
}

}  // namespace vla::bench
