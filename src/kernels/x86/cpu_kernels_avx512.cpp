// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/cpu_kernels_make.h"
#include "kernels/x86/vec_avx512.h"

namespace vla::kernels {

extern const CpuKernels kAvx512Kernels;
const CpuKernels kAvx512Kernels = CpuKernelsMaker<FloatProducts<Avx512, 12>>::make();

}  // namespace vla::kernels
