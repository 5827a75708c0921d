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

/// The limits that the options name, or none. Errors: usage, for a file that holds none.
Result<std::optional<control::Limits>> read_limits(const ServerOptions& options);

/// What the rows of a robot's chunks may be: ranges, and the steps from one row to the next. Where the robot is when a
/// row is commanded, and so the step to it, only its own loop knows. The thread that computes uses it.
class ChunkLimits {
 public:
  /// `robot`: the description of one robot. Errors: usage, where columns or units are not those of the limits, or where
  /// the bundle does not say the control rate that velocities need.
  static Result<ChunkLimits> of(const control::Limits& limits, const ServerOptions& options,
                                const v1::Description& robot, const std::string& bundle);

  /// Counts the rows that break a limit, and adds a note that says which columns do. Errors: bad_action, where
  /// --on-limit refuses such rows, or more of them do than the limits permit.
  Status check(ActionChunk& chunk, int& n_beyond);

 private:
  ChunkLimits(const control::Limits& limits, double rate_hz, bool refuses);
  std::string told(const ActionChunk& chunk, int n_beyond, int first);

  std::vector<std::string> names_;
  control::Limiter all_;
  std::vector<control::Limiter> each_;  // of one column
  bool refuses_;
};

}  // namespace vla::serve
