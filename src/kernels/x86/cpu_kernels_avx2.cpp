// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/cpu_kernels_make.h"
#include "kernels/x86/vec_avx2.h"

namespace vla::kernels {

extern const CpuKernels kAvx2Kernels;
const CpuKernels kAvx2Kernels = CpuKernelsMaker<FloatProducts<Avx2, 6>>::make();

}  // namespace vla::kernels
