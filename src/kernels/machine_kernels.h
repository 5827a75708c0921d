// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/cpu_kernels.h"
#include "kernels/linear_kernel.h"
#include "kernels/probe/probe.h"

/// The kernels that a processor's family adds to the portable ones. The build takes one folder of x86, arm and other,
/// which says all of it in its machine_kernels.cpp.
namespace vla::kernels::machine {

using LinearKernels = std::span<const LinearKernel* const>;

/// Products of floats, of ternary weights, of int4 and of int8 ones, best first.
LinearKernels linear_kernels();
LinearKernels ternary_kernels();
LinearKernels int4_kernels();
LinearKernels int8_kernels();

/// Null where none runs with these features.
const CpuKernels* cpu_kernels(Features use);

/// Every loop that there is, the slowest instructions first.
std::span<const PeakProbe> peak_probes();

}  // namespace vla::kernels::machine
