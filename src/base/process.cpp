// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "base/process.h"

#include <unistd.h>

#include <fstream>

namespace vla {

std::size_t resident_size() {
  std::ifstream file("/proc/self/statm");
  std::size_t size = 0, resident = 0;  // pages
  file >> size >> resident;
  return resident * static_cast<std::size_t>(::sysconf(_SC_PAGESIZE));
}

}  // namespace vla
