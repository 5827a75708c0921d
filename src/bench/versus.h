// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "bench/report.h"

namespace vla::bench {

/// An earlier report, read from the JSON that `to_json` wrote, to be compared with.
class Earlier {
 public:
  /// Errors: io, usage (not such a report).
  static Result<Earlier> read(const std::string& path);

  /// Times can only be compared of the same work. Errors: usage, naming what differs.
  Status check(const Conditions& now) const;
  /// Earlier time over present time, stage by stage, with a warning where the machine itself was another.
  std::string compare(const Report& now) const;

 private:
  std::string path_, cpu_;
  Conditions conditions_;
  double peak_ = 0;
  std::vector<std::pair<std::string, double>> stages_;  // ms, medians
};

}  // namespace vla::bench
