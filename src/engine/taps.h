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
/// Reads what `write_taps` or the golden writer wrote. Errors: io, bad_bundle.
Result<std::vector<Tap>> read_taps(const std::string& file);

/// How far one recorded value is from what was expected.
struct TapDifference {
  std::string path;
  double max_abs = 0;      // largest difference of two elements
  double relative = 0;     // the same, in units of the largest expected magnitude
  double cosine = 1;       // of the two values as vectors
  bool comparable = true;  // same shape, all values finite
  bool within(double tolerance) const { return comparable && relative <= tolerance; }
};

/// Differences of the taps that stand in both lists, in the order of `expected`.
std::vector<TapDifference> compare_taps(const std::vector<Tap>& expected, const std::vector<Tap>& got);

}  // namespace vla
