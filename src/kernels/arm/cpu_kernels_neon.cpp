// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/arm/attention_neon.h"
#include "kernels/cpu_kernels_make.h"

namespace vla::kernels {

extern const CpuKernels kNeonKernels;
const CpuKernels kNeonKernels = CpuKernelsMaker<NeonProducts>::make();

}  // namespace vla::kernels
