// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// `published_tool ARCH STORED` prints a path of a bundle of the published size without weights, and keeps it until
// standard input ends. Without arguments it prints the architectures. least_test.py runs `vla` with such bundles.
#include <unistd.h>

#include <cstdio>
#include <iostream>
#include <limits>

#include "support/published.h"

using namespace vla;

int main(int argc, char** argv) {
  if (argc != 3) {
    for (const PolicyEntry& entry : policy_registry()) std::printf("%s\n", entry.name.c_str());
    return 0;
  }
  const auto entry = find_policy(argv[1]);
  if (!entry) return std::fprintf(stderr, "%s\n", entry.error().message().c_str()), 1;
  const auto made = test::PublishedBundle::make(*entry, argv[2]);
  if (!made) return std::fprintf(stderr, "%s\n", made.error().message().c_str()), 1;
  const std::string path = made->path();
  std::printf("/proc/%d/fd/%s\n", static_cast<int>(::getpid()), path.substr(path.rfind('/') + 1).c_str());
  std::fflush(stdout);
  std::cin.ignore(std::numeric_limits<std::streamsize>::max());
}
