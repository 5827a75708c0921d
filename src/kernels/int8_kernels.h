// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/linear_kernel.h"

namespace vla::kernels {

/// Kernels for products of ternary, int4 and int8 matrices, best first; the last one runs on every machine. All kernels
/// of a list read the same packed weights and codes and give the same bits, up to the activation.
std::span<const LinearKernel* const> ternary_kernels();
std::span<const LinearKernel* const> int4_kernels();
std::span<const LinearKernel* const> int8_kernels();

}  // namespace vla::kernels
