// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <ggml.h>

#include "lower/host/packing.h"

namespace vla {

/// The type of tensors that have these elements; bytes of codes.
ggml_type type_of(DType type);

/// How a matrix lies in a tensor of float32, bf16 or float16: rows one after the other. Ternary codes are float32
/// without their scale.
lower::MatrixPlace place_of(const Param& matrix, ggml_type type);

}  // namespace vla
