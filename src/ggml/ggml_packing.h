// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <ggml.h>

#include "lower/host/packing.h"

namespace vla {

/// The ggml type for elements of this dtype; codes are bytes.
ggml_type type_of(DType type);

/// Packs a matrix into a tensor of float32, bf16 or float16, row by row. Ternary codes become float32 without their
/// scale.
lower::MatrixPlace place_of(const Param& matrix, ggml_type type);

}  // namespace vla
