// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/cpu_kernels.h"
#include "kernels/linear_kernel.h"
#include "kernels/probe/probe.h"

/// Kernels for a family of processors, in addition to the portable ones. The build takes one of the folders x86, arm
/// and other, which defines these functions in machine_kernels.cpp.
namespace vla::kernels::machine {

using LinearKernels = std::span<const LinearKernel* const>;

/// Kernels for products of floats, ternary, int4 and int8 weights, best first.
LinearKernels linear_kernels();
LinearKernels ternary_kernels();
LinearKernels int4_kernels();
LinearKernels int8_kernels();

/// Null if none runs with these features.
const CpuKernels* cpu_kernels(Features use);

/// All peak loops, the slowest instructions first.
std::span<const PeakProbe> peak_probes();

}  // namespace vla::kernels::machine
