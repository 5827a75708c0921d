// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#if defined(__x86_64__)
#include "kernels/cpu_kernels_make.h"

namespace vla::kernels {

extern const CpuKernels kAvx2Kernels;
const CpuKernels kAvx2Kernels = CpuKernelsMaker<Avx2, 6>::make();

}  // namespace vla::kernels
#endif
