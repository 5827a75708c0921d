// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/machine_kernels.h"

namespace vla::kernels::machine {

LinearKernels linear_kernels() { return {}; }
LinearKernels ternary_kernels() { return {}; }
LinearKernels int4_kernels() { return {}; }
LinearKernels int8_kernels() { return {}; }
const CpuKernels* cpu_kernels(Features) { return nullptr; }
std::span<const PeakProbe> peak_probes() { return {}; }

}  // namespace vla::kernels::machine
