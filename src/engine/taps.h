// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "base/result.h"

namespace vla {

/// A recorded value. `shape` follows ggml, fastest first.
struct Tap {
  std::string path;
  std::vector<std::int64_t> shape;
  std::vector<float> values;
};

/// `*` matches any characters; several patterns are separated by commas: `lm.blk.*,chunk`.
bool match_path(const std::string& pattern, const std::string& path);

/// Writes taps as f32 tensors of a GGUF file. Errors: io.
Status write_taps(const std::vector<Tap>& taps, const std::string& file);
/// Reads a file of `write_taps` or of the golden writer. Errors: io, bad_bundle.
Result<std::vector<Tap>> read_taps(const std::string& file);

/// The difference of one recorded value from the expected one.
struct TapDifference {
  std::string path;
  double max_abs = 0;      // largest difference of two elements
  double relative = 0;     // the same, divided by the largest expected magnitude
  double cosine = 1;       // cosine of the two values as vectors
  bool comparable = true;  // same shape and all values finite
  bool within(double tolerance) const { return comparable && relative <= tolerance; }
};

/// Differences of the taps that both lists have, in the order of `expected`.
std::vector<TapDifference> compare_taps(const std::vector<Tap>& expected, const std::vector<Tap>& got);

}  // namespace vla
