// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "quantize/smoothing.h"

namespace vla {

/// Bundles of one policy whose large matrices are codes: without and with all scalings.
struct CodedPair {
  std::string plain, smoothed;
};

/// Returns the scalings that help by themselves: with them, codes cause smaller errors in the products of the matrices
/// that read the value. Rows of the value are sampled in the acts of the observations and rounded as the CPU's int8
/// kernels round them. `floats`: the bundle that the codes come from. `options` configure the engines. Errors: those of
/// Engine.
Result<std::vector<Scaling>> helpful_scalings(const std::string& floats, const CodedPair& coded, Rounding codes,
                                              std::span<const Scaling> scalings, std::span<const Judged> observations,
                                              EngineOptions options);

}  // namespace vla
