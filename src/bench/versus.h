// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "bench/report.h"

namespace vla::bench {

/// An earlier report to compare with, parsed from the output of `to_json`.
class Earlier {
 public:
  /// Errors: io, usage (not a report).
  static Result<Earlier> read(const std::string& path);

  /// Checks that both reports measured the same work. Errors: usage, naming what differs.
  Status check(const Conditions& now) const;
  /// Earlier time over present time for each stage, with a warning if the machine's peaks differ.
  std::string compare(const Report& now) const;

 private:
  std::string path_, cpu_;
  Conditions conditions_;
  double peak_ = 0;
  std::vector<std::pair<std::string, double>> stages_;  // ms, medians
};

}  // namespace vla::bench
