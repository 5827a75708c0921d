// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <iosfwd>
#include <string>
#include <vector>

namespace vla::bench {

/// The limits of this machine, measured: multiply-adds by instruction set, and reading memory beyond the caches.
struct Roofs {
  struct Peak {
    std::string name;
    double one = 0, all = 0;  // operations per second, one thread and all
  };
  std::vector<Peak> peaks;
  double bandwidth = 0;  // bytes per second, all threads

  /// The rate of all threads under this name.
  double peak(const std::string& name) const;
};

/// Takes a second or less. The machine should do nothing else.
Roofs measure_roofs(int n_thread);

/// As the system names it; of ARM64 its cores, of which it says the part numbers only: "4 Cortex-A55, 4 Cortex-A76".
std::string cpu_name();
/// The cores that /proc/cpuinfo lists by ARM's part numbers, in its order; empty where it lists none.
std::string arm_cores(std::istream& cpuinfo);

/// Seconds that all threads of this process have run.
double cpu_seconds();

/// Memory of this process as the system counts it, in bytes; 0 where it does not say.
struct ProcessMemory {
  std::size_t peak = 0, now = 0;
};
ProcessMemory process_memory();
/// Resets the peak. False where the system does not allow it.
bool forget_peak_memory();

}  // namespace vla::bench
