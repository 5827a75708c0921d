// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "base/process.h"

#include <unistd.h>

#include <algorithm>
#include <cstdlib>
#include <fstream>
#include <sstream>

namespace vla {
namespace {

std::string content(const char* path) {
  std::ifstream in(path);
  std::ostringstream text;
  text << in.rdbuf();
  return text.str();
}

}  // namespace

std::size_t resident_size() {
  std::ifstream file("/proc/self/statm");
  std::size_t size = 0, resident = 0;  // pages
  file >> size >> resident;
  return resident * static_cast<std::size_t>(::sysconf(_SC_PAGESIZE));
}

std::size_t free_memory(const std::string& meminfo, const std::string& limit, const std::string& used) {
  const std::string key = "MemAvailable:";
  const std::size_t at = meminfo.find(key);
  const auto number = [](const char* text) { return static_cast<std::size_t>(std::strtoull(text, nullptr, 10)); };
  const std::size_t system = at == std::string::npos ? 0 : 1024 * number(meminfo.c_str() + at + key.size());
  if (limit.empty() || used.empty() || limit.starts_with("max")) return system;
  const std::size_t most = number(limit.c_str()), now = number(used.c_str());
  return std::min(system, most - std::min(most, now));
}

std::size_t free_memory() {
  return free_memory(content("/proc/meminfo"), content("/sys/fs/cgroup/memory.max"),
                     content("/sys/fs/cgroup/memory.current"));
}

}  // namespace vla
