// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "bundle/params.h"

/// Matrices in another encoding than that of the bundle, because somebody asked for it.
namespace vla {

/// The conversion of matrices as they are loaded: large ones of floats are rounded to bf16, int8 or int4, or quantized
/// ones become float32 again.
enum class Rounding { none, bf16, int8, int4, float32 };

/// The encoding of a parameter in memory; int8 and int4 have a scale for each row of a matrix. Matrices from or to
/// fewer than 144 elements keep theirs: they take no time worth an error, and padded states and actions of robots have
/// up to 132 elements (GR00T N1.7).
Encoding resident_encoding(const Param& param, Rounding rounding);

/// Errors: unsupported where no matrix would have the encoding that was asked for.
Status check_rounding(const ParamList& list, Rounding rounding);

}  // namespace vla
