// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "quantize/search.h"

namespace vla {

/// A policy prepared for quantization, based on measured activations.
struct Calibrated {
  std::string bundle;              // the file to quantize: a smoothed or rotated one, or the given one
  std::vector<std::string> codes;  // bundles with codes that compensate each other's errors: int8, int4 or both; only
                                   // where they are better than plain codes
  std::string why;                 // what was done, for `quantize`; empty if nothing
  std::vector<std::string> told;   // a report line for each attempt
};

/// Tries smoothing (smoothing.h) for matrices in `codes`, in all places and in those where it helps by itself
/// (product_errors.h), rotation (rotation.h), and codes by Hessians (hessians.h), also in int4 if `has_int4`. Keeps the
/// variant that moves chunks least. Every second observation compares variants that the others made; with fewer than
/// four, all do both. The kept codes are made by all. The names of its files begin with `to`. `options` configure the
/// engines. Errors: those of find_smoothing, write_smoothed, find_rotations, write_rotated, Hessians and `quantize`.
Result<Calibrated> calibrate(const std::string& from, const std::string& to, Rounding codes, bool has_int4,
                             std::vector<Judged> observations, const EngineOptions& options,
                             const std::function<void(QuantizeProgress)>& report);

}  // namespace vla
