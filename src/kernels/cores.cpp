// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/cores.h"

#include <sched.h>

#include <algorithm>
#include <fstream>

namespace vla::kernels {

std::vector<int> allowed_cores() {
  cpu_set_t set;
  std::vector<int> cores;
  if (sched_getaffinity(0, sizeof(set), &set) == 0)
    for (int i = 0; i < CPU_SETSIZE; ++i)
      if (CPU_ISSET(i, &set)) cores.push_back(i);
  return cores.empty() ? std::vector<int>{0} : cores;
}

std::vector<int> big_cores(const std::vector<int>& cores, const std::string& folder) {
  std::vector<long> capacities;
  for (const int core : cores) {
    long capacity = 0;
    std::ifstream(folder + "/cpu" + std::to_string(core) + "/cpu_capacity") >> capacity;
    if (capacity <= 0) return cores;
    capacities.push_back(capacity);
  }
  const long greatest = *std::max_element(capacities.begin(), capacities.end());
  std::vector<int> big;
  for (std::size_t i = 0; i < cores.size(); ++i)
    if (4 * capacities[i] >= 3 * greatest) big.push_back(cores[i]);
  return big;
}

void stay_on(const std::vector<int>& cores) {
  cpu_set_t set;
  CPU_ZERO(&set);
  for (const int core : cores) CPU_SET(core, &set);
  sched_setaffinity(0, sizeof(set), &set);
}

}  // namespace vla::kernels
