// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>

#include "quantize/search.h"

namespace vla {

/// A gain that is folded into matrices before channels are rotated, then set to ones.
struct Folded {
  std::string gain;
  std::string bias;                        // divided by the gain; empty if there is none
  std::vector<std::string> columns, rows;  // their columns or rows are multiplied; a bias is a row
};

/// Channels that are rotated together, and the tensors that this changes.
struct Rotation {
  std::int64_t d = 0;                 // each `d` consecutive channels are rotated by the same matrix
  std::vector<std::string> elements;  // tensors whose first dimension is rotated
  std::vector<std::string> rows;      // matrices whose second dimension is rotated
  std::vector<Folded> folded;
};

/// By the module whose stream it is, or under "heads" for the values of all attention heads.
using Rotations = std::map<std::string, std::vector<Rotation>>;

/// Finds channels that may be rotated (rotation_places.h): residual streams that only norms read, and the values of
/// attention heads. A rotation spreads channels that are far larger than the others, so codes lose less of the rest.
/// Sources: QuaRot (arXiv 2404.00456), SpinQuant (arXiv 2405.16406). `options` configure the engine. Errors: those of
/// Engine and Bundle::open.
Result<Rotations> find_rotations(const std::string& bundle, const EngineOptions& options);

/// Writes a bundle with these channels rotated, in the dtypes of `from`. It computes the same function but for the
/// rounding of its weights. A matrix whose rows are rotated is in memory in float32. Errors: those of Bundle::open; io.
Status write_rotated(const std::string& from, const std::string& to, std::span<const Rotation> rotations);

}  // namespace vla
