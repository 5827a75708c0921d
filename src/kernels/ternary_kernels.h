// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/linear_kernel.h"

namespace vla::kernels {

/// The implementations of products of ternary matrices, best first; the last runs on every machine. All read the same
/// packed weights and the same codes, and give the same bits up to the activation.
std::span<const LinearKernel* const> ternary_kernels();

}  // namespace vla::kernels
