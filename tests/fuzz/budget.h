// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <sys/resource.h>

#include <cstdio>
#include <cstdlib>
#include <ctime>

namespace vla::fuzz {

/// What one input may cost: processor time of this process, and memory beyond the most that it had before. The
/// sanitizers multiply both by about four.
class Budget {
 public:
  Budget(double seconds, long megabytes) : seconds_(seconds), kilobytes_(megabytes * 1024) {}
  /// Aborts where it was exceeded, as a fuzzer expects.
  ~Budget() {
    const double took = static_cast<double>(std::clock() - start_) / CLOCKS_PER_SEC;
    const long grew = peak() - peak_;
    if (took <= seconds_ && grew <= kilobytes_) return;
    std::fprintf(stderr, "an input took %.1f s and %ld kB, of %.1f and %ld\n", took, grew, seconds_, kilobytes_);
    std::abort();
  }
  Budget(const Budget&) = delete;
  Budget& operator=(const Budget&) = delete;

 private:
  static long peak() {
    rusage usage = {};
    getrusage(RUSAGE_SELF, &usage);
    return usage.ru_maxrss;
  }

  double seconds_;
  long kilobytes_;
  std::clock_t start_ = std::clock();
  long peak_ = peak();
};

}  // namespace vla::fuzz
