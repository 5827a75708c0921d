// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "quantize/search.h"

namespace vla {

/// A value whose channels are divided, and the tensors that this changes.
struct Scaling {
  std::string path;                  // of the value's tap
  std::vector<float> by;             // what its channels are divided by: powers of two, not all 1
  std::vector<std::string> readers;  // matrices that read it: their columns are multiplied
  std::vector<std::string> vectors;  // weights and biases that make it: their elements are divided
  std::vector<std::string> rows;     // matrices that make it: their rows are divided
};

struct Smoothing {
  int n_place = 0;                // norms and gated MLPs that only matrices of floats read
  std::vector<Scaling> scalings;  // for those of them with a channel that stands out
  Chunks chunks;                  // the observations' chunks in float32
};

/// Finds how a policy can have activations and matrices that lose less when they become codes. Where a channel of what
/// matrices read is far larger than the others, a row's scale is spent on it: it may be divided by a power of two in
/// the norm, or in the product of a gated MLP, that it comes from, and the columns of the matrices that read it
/// multiplied by the same. Powers of two change no digit, so that actions in float32 are the same to the bit. A
/// channel's factor is sqrt(max |x| / max |W|) beside that of the others, x over the observations. Source of the rule:
/// SmoothQuant, alpha = 0.5 (arXiv 2211.10438). `options`: of the engines, all in float32. Errors: those of Engine;
/// unsupported where the policy has no such place.
Result<Smoothing> find_smoothing(const std::string& bundle, std::span<const Judged> observations,
                                 EngineOptions options);

/// Writes a bundle of the same function with these channels divided. Errors: those of Bundle::open; io.
Status write_smoothed(const std::string& from, const std::string& to, std::span<const Scaling> scalings);

}  // namespace vla
