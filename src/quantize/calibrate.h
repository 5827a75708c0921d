// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "quantize/search.h"

namespace vla {

/// A policy made ready for codes by what its matrices multiply.
struct Calibrated {
  std::string bundle;  // the file that codes are made of: the smoothed one, or the one that was given
  std::string int4;    // the file of it with int4 codes that make each other's errors good; empty where none is better
  std::string why;     // what was done, for `quantize`; empty where nothing was
  std::vector<std::string> told;  // what was tried
};

/// Tries smoothing (smoothing.h) for matrices in `codes`, then codes of int4 by Hessians (hessians.h) where `has_int4`,
/// and keeps what moves the chunks of the observations less. It writes to `to` with an ending, and leaves what it keeps
/// there. `options`: of the engines. Errors: those of `smooth`, Hessians and `quantize`.
Result<Calibrated> calibrate(const std::string& from, const std::string& to, Rounding codes, bool has_int4,
                             std::span<const Judged> observations, const EngineOptions& options,
                             const std::function<void(QuantizeProgress)>& report);

}  // namespace vla
