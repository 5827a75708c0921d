// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "quantize/search.h"

namespace vla {

/// How much was smoothed, and what it was measured by.
struct Smoothed {
  int n_place = 0;    // norms and gated MLPs that only matrices of floats read
  int n_channel = 0;  // how many of them were divided
  float largest = 1;  // factor
  Chunks chunks;      // the observations' chunks in float32
};

/// Writes a bundle of the same function whose activations and matrices lose less when they become codes. Where a
/// channel of what matrices read is far larger than the others, a row's scale is spent on it: here it is divided by a
/// power of two in the norm, or in the product of a gated MLP, that it comes from, and the columns of the matrices that
/// read it are multiplied by the same. Powers of two change no digit, so that actions in float32 are the same to the
/// bit. A channel's factor is sqrt(max |x| / max |W|) beside that of the others, x over the observations. Source of the
/// rule: SmoothQuant, alpha = 0.5 (arXiv 2211.10438). `options`: of the engines, all in
/// float32. Errors: those of Engine; unsupported where the policy has no such place; io.
Result<Smoothed> smooth(const std::string& from, const std::string& to, std::span<const Judged> observations,
                        EngineOptions options);

}  // namespace vla
