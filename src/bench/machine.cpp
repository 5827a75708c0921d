// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "bench/machine.h"

#include <fmt/format.h>

#include <algorithm>
#include <ctime>
#include <fstream>
#include <utility>

#include "base/process.h"
#include "kernels/probe/probe.h"

namespace vla::bench {
namespace {

/// The value of `key` in a file of /proc, or empty.
std::string proc_line(const char* file, const std::string& key) {
  std::ifstream in(file);
  for (std::string line; std::getline(in, line);) {
    const std::size_t colon = line.find(':');
    if (colon == std::string::npos || line.compare(0, key.size(), key) != 0) continue;
    const std::size_t text = line.find_first_not_of(" \t", colon + 1);
    return text == std::string::npos ? "" : line.substr(text);
  }
  return "";
}

/// ARM's part numbers. Source: Linux, arch/arm64/include/asm/cputype.h.
constexpr std::pair<unsigned, const char*> kArmParts[] = {
    {0xd03, "Cortex-A53"},   {0xd05, "Cortex-A55"},    {0xd07, "Cortex-A57"},  {0xd08, "Cortex-A72"},
    {0xd09, "Cortex-A73"},   {0xd0a, "Cortex-A75"},    {0xd0b, "Cortex-A76"},  {0xd0c, "Neoverse-N1"},
    {0xd0d, "Cortex-A77"},   {0xd0e, "Cortex-A76AE"},  {0xd40, "Neoverse-V1"}, {0xd41, "Cortex-A78"},
    {0xd42, "Cortex-A78AE"}, {0xd44, "Cortex-X1"},     {0xd46, "Cortex-A510"}, {0xd47, "Cortex-A710"},
    {0xd48, "Cortex-X2"},    {0xd49, "Neoverse-N2"},   {0xd4b, "Cortex-A78C"}, {0xd4d, "Cortex-A715"},
    {0xd4e, "Cortex-X3"},    {0xd4f, "Neoverse-V2"},   {0xd80, "Cortex-A520"}, {0xd81, "Cortex-A720"},
    {0xd82, "Cortex-X4"},    {0xd83, "Neoverse-V3AE"}, {0xd84, "Neoverse-V3"}, {0xd85, "Cortex-X925"},
    {0xd87, "Cortex-A725"}};

std::string arm_core(unsigned implementer, unsigned part) {
  if (implementer == 0x41)
    for (const auto& [number, name] : kArmParts)
      if (number == part) return name;
  return fmt::format("core {:#x}:{:#x}", implementer, part);
}

std::size_t status_bytes(const std::string& key) {
  const std::string text = proc_line("/proc/self/status", key);  // "1234 kB"
  return text.empty() ? 0 : std::size_t{1024} * std::strtoull(text.c_str(), nullptr, 10);
}

}  // namespace

double Roofs::peak(const std::string& name) const {
  for (const Peak& peak : peaks)
    if (peak.name == name) return peak.all;
  return 0;
}

Roofs measure_roofs(int n_thread) {
  constexpr double kSeconds = 0.08;
  Roofs roofs;
  for (const kernels::PeakProbe& probe : kernels::peak_probes())
    roofs.peaks.push_back(
        {probe.name, kernels::measure_peak(probe, 1, kSeconds), kernels::measure_peak(probe, n_thread, kSeconds)});
  roofs.bandwidth = kernels::measure_read_bandwidth(n_thread, 2 * kSeconds);
  return roofs;
}

std::string cpu_name() {
  std::ifstream cpuinfo("/proc/cpuinfo");
  std::string name = proc_line("/proc/cpuinfo", "model name");
  if (name.empty()) name = arm_cores(cpuinfo);
  return name.empty() ? "unnamed CPU" : name;
}

std::string arm_cores(std::istream& cpuinfo) {
  std::vector<std::pair<std::string, int>> all;
  unsigned implementer = 0;
  for (std::string line; std::getline(cpuinfo, line);) {
    const auto number = [&] {
      return static_cast<unsigned>(std::strtoul(line.c_str() + line.find(':') + 1, nullptr, 16));
    };
    if (line.starts_with("CPU implementer")) implementer = number();
    if (!line.starts_with("CPU part")) continue;
    const std::string name = arm_core(implementer, number());
    const auto known = std::find_if(all.begin(), all.end(), [&](const auto& core) { return core.first == name; });
    known == all.end() ? void(all.emplace_back(name, 1)) : void(++known->second);
  }
  std::string text;
  for (const auto& [name, count] : all) text += fmt::format("{}{} {}", text.empty() ? "" : ", ", count, name);
  return text;
}

double cpu_seconds() {
  timespec time = {};
  ::clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &time);
  return static_cast<double>(time.tv_sec) + 1e-9 * static_cast<double>(time.tv_nsec);
}

ProcessMemory process_memory() { return {status_bytes("VmHWM"), resident_size()}; }

bool forget_peak_memory() {
  std::ofstream out("/proc/self/clear_refs");
  return static_cast<bool>(out << 5 << std::flush);
}

}  // namespace vla::bench
