// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "bench/doctor.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "cli/commands.h"
#include "cli/json.h"
#include "cli/say.h"

namespace vla::cli {
namespace {

#ifdef VLA_SERVER
constexpr bool kServer = true;
#else
constexpr bool kServer = false;
#endif

struct DoctorOptions {
  std::string bundle, kernels, device, embodiment;
  int n_thread = 0;
  bool json = false;
};

std::string gigabytes(std::size_t bytes) { return fmt::format("{:.2g} GB", 1e-9 * static_cast<double>(bytes)); }

void print_machine(const bench::Machine& machine, const DeviceList& devices) {
  say(stdout, "machine   {}, {} core{}; kernels: {}\n", machine.cpu, machine.n_core, machine.n_core == 1 ? "" : "s",
      fmt::format("{}", fmt::join(machine.kernels, ", ")));
  std::vector<std::string> peaks;
  for (const auto& peak : machine.roofs.peaks) peaks.push_back(fmt::format("{} {:.0f}", peak.name, 1e-9 * peak.all));
  say(stdout, "peaks     {} giga-operations a second; memory {:.1f} GB/s\n", fmt::format("{}", fmt::join(peaks, ", ")),
      1e-9 * machine.roofs.bandwidth);
  say(stdout, "memory    {} free\n", gigabytes(machine.free_memory));
  say(stdout, "governor  {}\n", machine.governor.empty() ? "not told here" : machine.governor);
  say(stdout, "load      {:.2f} threads on {} cores in the last minute{}\n", machine.load, machine.n_core,
      machine.load > 0.5 ? ": other programs take part of what is measured" : "");
  say(stdout, "build     vla {}, {} the server\n", VLA_VERSION, kServer ? "with" : "without");
  for (const DeviceInfo& device : devices.devices)
    say(stdout, "device    {}{}: {}\n", device.name,
        device.free > 0 ? fmt::format(", {} free", gigabytes(device.free)) : "", device.description);
  for (const auto& [kind, reason] : devices.absent) say(stdout, "          no {}: {}\n", kind, reason);
}

std::string milliseconds(double ms) { return ms > 0 ? fmt::format("{:.{}f}", ms, ms < 100 ? 2 : 0) : "-"; }

void print_policy(const bench::Checkup& c) {
  const bench::Conditions& k = c.report.conditions;
  say(stdout, "\npolicy    {} ({}), weights {}: {} on {}, {}\n", k.policy, k.source, k.weights, k.kernels, k.device,
      c.report.arithmetic);
  say(stdout, "memory    {:.0f} MB\n", 1e-6 * static_cast<double>(c.predicted_memory));
  say(stdout, "stage         predicted ms  measured ms\n");
  for (const auto& stage : c.stages)
    say(stdout, "  {:<12}  {:>11}  {:>11}\n", stage.name, milliseconds(stage.predicted), milliseconds(stage.measured));
  say(stdout, "  {:<12}  {:>11}  {:>11}\n", "images, text", "", milliseconds(c.host));
  say(stdout, "  {:<12}  {:>11}  {:>11}\n", "an act", "", milliseconds(c.total));
  if (c.report.conditions.on_cpu() && c.cores < 0.9 * k.n_thread)
    say(stdout, "          on {:.2f} of {} cores: measure again on a quiet machine, or give it fewer --threads\n",
        c.cores, k.n_thread);
  if (c.rate_hz > 0)
    say(stdout, "rate      {:g} rows a second, {} in a chunk: replan every {} rows or more{}\n", c.rate_hz, c.horizon,
        c.replan_rows(), c.holds_rate() ? "" : ", so the rate is not held");
  else
    say(stdout, "rate      the bundle states none; {:.3g} chunks a second\n", 1e3 / c.best());
}

/// Prints the settings that matter most. What int8 costs in accuracy is for the user to measure.
void print_settings(const bench::Checkup& c) {
  if (!c.report.conditions.on_cpu()) return;
  const int n_thread = c.report.conditions.n_thread;
  if (c.one_thread > 0)
    say(stdout, "settings  --threads {}: {} ms with 1 thread, {} with {}\n", c.one_thread < c.total ? 1 : n_thread,
        milliseconds(c.one_thread), milliseconds(c.total), n_thread);
  else
    say(stdout, "settings  --threads {}: cores that the robot's other programs need are better left out\n", n_thread);
  if (c.gains_by_int8())
    say(stdout,
        "          --kernels int8: {} ms of the network predicted instead of {}, less exact: docs/quantization.md\n",
        milliseconds(c.predicted_int8), milliseconds(c.predicted()));
  if (c.report.conditions.n_view > 1)
    say(stdout, "          fewer views: vision is {:.0f} % of the network, here with {} views\n",
        100 * c.stages.front().measured / c.stages.back().measured, c.report.conditions.n_view);
}

Json machine_json(const bench::Machine& machine, const DeviceList& devices) {
  Json json = {{"cpu", machine.cpu},
               {"cores", machine.n_core},
               {"kernels", machine.kernels},
               {"bandwidth_gbytes_per_s", 1e-9 * machine.roofs.bandwidth},
               {"free_memory_bytes", machine.free_memory},
               {"load", machine.load}};
  json["governor"] = machine.governor.empty() ? Json() : Json(machine.governor);
  for (const auto& peak : machine.roofs.peaks) json["peaks_gflops"][peak.name] = 1e-9 * peak.all;
  for (const DeviceInfo& device : devices.devices)
    json["devices"].push_back({{"name", device.name},
                               {"description", device.description},
                               {"free_bytes", device.free > 0 ? Json(device.free) : Json()}});
  json["absent_devices"] = Json::object();
  for (const auto& [kind, reason] : devices.absent) json["absent_devices"][kind] = reason;
  return json;
}

Json policy_json(const bench::Checkup& c) {
  const bench::Conditions& k = c.report.conditions;
  Json json = {{"arch", k.policy},      {"kernels", k.kernels},
               {"device", k.device},    {"precision", c.report.precision},
               {"threads", k.n_thread}, {"memory_bytes", c.predicted_memory},
               {"act_ms", c.total},     {"host_ms", c.host},
               {"cores", c.cores}};
  for (const auto& stage : c.stages) {
    json["stages"][stage.name]["measured_ms"] = stage.measured;
    json["stages"][stage.name]["predicted_ms"] = stage.predicted > 0 ? Json(stage.predicted) : Json();
  }
  if (c.one_thread > 0) json["one_thread_act_ms"] = c.one_thread;
  json["int8_predicted_ms"] = c.predicted_int8 > 0 ? Json(c.predicted_int8) : Json();
  json["rate_hz"] = c.rate_hz > 0 ? Json(c.rate_hz) : Json();
  json["horizon"] = c.horizon;
  json["replan_rows"] = c.rate_hz > 0 ? Json(c.replan_rows()) : Json();
  json["holds_rate"] = c.holds_rate();
  return json;
}

Json error_json(const Error& error) {
  return {{"code", code_name(error.code)},
          {"where", error.where},
          {"expected", error.expected},
          {"found", error.found},
          {"hint", error.hint}};
}

Status doctor(const DoctorOptions& options) {
  VLA_TRY(const bench::Machine machine, bench::examine_machine());
  const DeviceList devices = list_devices();
  Json root = {{"machine", machine_json(machine, devices)}, {"build", {{"version", VLA_VERSION}, {"server", kServer}}}};
  if (!options.json) print_machine(machine, devices);
  Status verdict;
  if (!options.bundle.empty()) {
    bench::Request request;
    request.bundle = options.bundle, request.kernels = options.kernels, request.device = options.device;
    request.embodiment = options.embodiment, request.n_thread = options.n_thread, request.n_round = 5;
    const bench::Watcher watcher = {[](const std::string& line) { say(stderr, "{}\n", line); },
                                    [] { return Status(); }};
    const auto checkup = bench::examine_policy(request, machine, watcher);
    if (!checkup) {
      root["refused"] = error_json(checkup.error());
      verdict = checkup.error();
    } else {
      root["policy"] = policy_json(*checkup);
      if (!options.json) print_policy(*checkup), print_settings(*checkup);
      if (!checkup->holds_rate())
        verdict = Error{
            Code::late, options.bundle,
            fmt::format("an act within the {:.0f} ms that a chunk lasts", 1e3 * checkup->horizon / checkup->rate_hz),
            fmt::format("{:.0f} ms", checkup->best()), "a faster device, or a smaller or quantized policy"};
    }
  }
  if (options.json) say_lines(stdout, text_of(root) + "\n");
  return verdict;
}

}  // namespace

Command add_doctor(CLI::App& app) {
  auto options = std::make_shared<DoctorOptions>();
  CLI::App* command =
      app.add_subcommand("doctor", "Show what this machine and this build can do, and what a policy will do here");
  command->footer(
      "  vla doctor\n  vla doctor policy.gguf\n  vla doctor policy.gguf --json > here.json\n"
      "Takes seconds, and a few acts of the policy. Exit codes beside those of vla run: 16 where a chunk is executed "
      "before the next one is there.");
  add_bundle(*command, options->bundle, false);
  command->add_option("--threads", options->n_thread, "CPU threads; 0 takes every core, of big and little ones the big")
      ->check(CLI::Range(0, 512))
      ->capture_default_str();
  add_text(*command, "--kernels", options->kernels, "NAME", kKernelsHelp);
  add_text(*command, "--device", options->device, "NAME", kDeviceHelp);
  add_text(*command, "--embodiment", options->embodiment, "TAG", kEmbodimentHelp);
  command->add_flag("--json", options->json, "Print one JSON object as the last line of output");
  return [options] { return doctor(*options); };
}

}  // namespace vla::cli
