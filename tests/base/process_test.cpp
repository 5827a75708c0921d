// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "base/process.h"

#include <doctest/doctest.h>

namespace process_test {

using namespace vla;

TEST_CASE("memory that a process could take is what the system and its group leave") {
  const std::string meminfo = "MemTotal:  8000 kB\nMemAvailable:    2000 kB\n";
  CHECK(free_memory(meminfo, "", "") == 2'048'000);
  CHECK(free_memory(meminfo, "max\n", "12\n") == 2'048'000);
  CHECK(free_memory(meminfo, "1000000\n", "400000\n") == 600'000);
  CHECK(free_memory(meminfo, "1000000\n", "1400000\n") == 0);
  CHECK(free_memory("", "", "") == 0);
}

TEST_CASE("a process takes memory, and less than all of it is left") {
  CHECK(resident_size() > 0);
  CHECK(free_memory() > 0);
}

}  // namespace process_test
