// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vla/control.h>

#include <string>
#include <vector>

#include "engine/robot.h"
#include "serve/options.h"
#include "wire/vla.pb.h"

namespace vla::serve {

/// Reads the limits file that the options name; none if they name no file. Errors: usage, for an invalid file, or for
/// --limits or --on-limit alone.
Result<std::optional<control::Limits>> read_limits(const ServerOptions& options);

/// Limits on the rows of a robot's chunks: ranges, and the steps from one row to the next. The step from the robot's
/// position to the first row is not checked: only the robot's own control loop knows that position. Only the computing
/// thread uses it.
class ChunkLimits {
 public:
  /// `robot`: the description of one robot. Errors: usage if columns or units differ from those of the limits, or if a
  /// limit per second needs a control rate that the bundle does not state.
  static Result<ChunkLimits> of(const control::Limits& limits, const ServerOptions& options,
                                const v1::Description& robot, const std::string& bundle);

  /// Counts the rows that break a limit, and adds a note that names the columns. Errors: bad_action if --on-limit
  /// refuses such rows, or if their share is larger than the limits permit.
  Status check(ActionChunk& chunk, int& n_beyond);

 private:
  ChunkLimits(const control::Limits& limits, double rate_hz, bool refuses);
  std::string told(const ActionChunk& chunk, int n_beyond, int first);

  std::vector<std::string> names_;
  control::Limiter all_;
  std::vector<control::Limiter> each_;  // one limiter for each column
  bool refuses_;
};

}  // namespace vla::serve
