// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <iosfwd>
#include <string>
#include <vector>

namespace vla::bench {

/// Measured limits of this machine: multiply-adds by instruction set, and memory bandwidth beyond the caches.
struct Roofs {
  struct Peak {
    std::string name;
    double one = 0, all = 0;  // operations per second, one thread and all
  };
  std::vector<Peak> peaks;
  double bandwidth = 0;  // bytes per second, all threads

  /// The rate of all threads for the probe of this name.
  double peak(const std::string& name) const;
};

/// Measures for a second or less; the machine should be idle.
Roofs measure_roofs(int n_thread);

/// The processor's name as the system gives it. ARM64 systems give part numbers only, so its cores are listed: "4
/// Cortex-A55, 4 Cortex-A76".
std::string cpu_name();
/// The cores that /proc/cpuinfo lists by ARM part number, in order; empty if it lists none.
std::string arm_cores(std::istream& cpuinfo);

/// Processor time of all threads of this process, in seconds.
double cpu_seconds();

/// Resident memory of this process in bytes; 0 if the system does not report it.
struct ProcessMemory {
  std::size_t peak = 0, now = 0;
};
ProcessMemory process_memory();
/// Resets the peak. False if the system refuses.
bool forget_peak_memory();

}  // namespace vla::bench
