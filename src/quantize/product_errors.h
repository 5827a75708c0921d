// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "quantize/smoothing.h"

namespace vla {

/// Bundles of one policy whose large matrices are codes: without and with all scalings.
struct CodedPair {
  std::string plain, smoothed;
};

/// Returns those scalings that help by themselves: with them, codes change the products of the matrices that read the
/// value less. Rows of the value are taken from the acts of the observations, and rounded as the CPU's kernels of
/// integers round them. `floats`: the bundle that the codes come from. `options`: of the engines. Errors: those of
/// Engine.
Result<std::vector<Scaling>> helpful_scalings(const std::string& floats, const CodedPair& coded, Rounding codes,
                                              std::span<const Scaling> scalings, std::span<const Judged> observations,
                                              EngineOptions options);

}  // namespace vla
