// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "quantize/search.h"

namespace vla {

/// A value whose channels are divided, and the tensors that this changes.
struct Scaling {
  std::string path;                  // path of the value's tap
  std::vector<float> by;             // divisors of its channels: powers of two, not all 1
  std::vector<std::string> readers;  // matrices that read it: their columns are multiplied
  std::vector<std::string> vectors;  // weights and biases that make it: their elements are divided
  std::vector<std::string> rows;     // matrices that make it: their rows are divided
};

struct Smoothing {
  int n_place = 0;                // norms and gated MLPs that only matrices of floats read
  std::vector<Scaling> scalings;  // for the places with an outlier channel
  Chunks chunks;                  // the observations' chunks in float32
};

/// Finds outlier channels of activations that can be divided, so that codes lose less. A channel far larger than the
/// others sets the scale of its row, which leaves few codes for the other channels. The norm, or the product of a gated
/// MLP, that computes it can divide it by a power of two, and the matrices that read it multiply their columns by the
/// same factor. Powers of two change no digit, so actions in float32 are the same to the bit. A channel's factor is its
/// sqrt(max |x| / max |W|) relative to the geometric mean of all channels, with x over the observations. Source of the
/// rule: SmoothQuant, alpha = 0.5 (arXiv 2211.10438). `options` configure the engines, which run in float32. Errors:
/// those of Engine; unsupported if the policy has no such place.
Result<Smoothing> find_smoothing(const std::string& bundle, std::span<const Judged> observations,
                                 EngineOptions options);

/// Writes a bundle that computes the same function with these channels divided. Errors: those of Bundle::open; io.
Status write_smoothed(const std::string& from, const std::string& to, std::span<const Scaling> scalings);

}  // namespace vla
