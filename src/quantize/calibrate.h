// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "quantize/search.h"

namespace vla {

/// A policy prepared for quantization by what its matrices multiply.
struct Calibrated {
  std::string bundle;              // the file to quantize: the smoothed one or the given one
  std::vector<std::string> codes;  // the same with codes that compensate each other's errors: int8, int4 or both, where
                                   // plain codes are not better
  std::string why;                 // what was done, for `quantize`; empty if nothing
  std::vector<std::string> told;   // what was tried
};

/// Tries smoothing (smoothing.h) for matrices in `codes`, everywhere and where it helps by itself (product_errors.h),
/// and codes by Hessians (hessians.h), also int4's if `has_int4`, and keeps what moves the observations' chunks less.
/// Its files are `to` plus an ending. `options`: of the engines. Errors: those of `smooth`, Hessians and `quantize`.
Result<Calibrated> calibrate(const std::string& from, const std::string& to, Rounding codes, bool has_int4,
                             std::span<const Judged> observations, const EngineOptions& options,
                             const std::function<void(QuantizeProgress)>& report);

}  // namespace vla
