// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "bench/machine.h"

#include <ctime>
#include <fstream>

#include "kernels/probe/probe.h"

namespace vla::bench {
namespace {

/// The text after `key` and a colon in a file of /proc, or nothing.
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
  const std::string name = proc_line("/proc/cpuinfo", "model name");
  return name.empty() ? "unnamed CPU" : name;
}

double cpu_seconds() {
  timespec time = {};
  ::clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &time);
  return static_cast<double>(time.tv_sec) + 1e-9 * static_cast<double>(time.tv_nsec);
}

ProcessMemory process_memory() { return {status_bytes("VmHWM"), status_bytes("VmRSS")}; }

bool forget_peak_memory() {
  std::ofstream out("/proc/self/clear_refs");
  return static_cast<bool>(out << 5 << std::flush);
}

}  // namespace vla::bench
