// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "bundle/params.h"

/// Converts matrices at load to another encoding than the bundle's, on request.
namespace vla {

/// The conversion to apply when matrices are loaded: large matrices of floats are rounded to bf16, int8 or int4, or
/// quantized ones become float32 again.
enum class Rounding { none, bf16, int8, int4, float32 };

/// The encoding of a parameter in memory. int8 and int4 have one scale per matrix row. Matrices with fewer than 144
/// inputs or outputs keep their encoding: they take too little time to be worth a rounding error, and padded states and
/// actions have up to 132 elements (GR00T N1.7).
Encoding resident_encoding(const Param& param, Rounding rounding);

/// Errors: unsupported if no matrix would get the requested encoding.
Status check_rounding(const ParamList& list, Rounding rounding);

}  // namespace vla
