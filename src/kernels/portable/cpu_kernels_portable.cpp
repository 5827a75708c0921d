// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/cpu_kernels_make.h"
#include "kernels/portable/vec_portable.h"

namespace vla::kernels {

extern const CpuKernels kPortableKernels;
const CpuKernels kPortableKernels = CpuKernelsMaker<FloatProducts<Portable, 4>>::make();

}  // namespace vla::kernels
