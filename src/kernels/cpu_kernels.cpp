// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/cpu_kernels.h"

#include "kernels/cpu_kernels_make.h"

namespace vla::kernels {

#if defined(__x86_64__)
extern const CpuKernels kAvx2Kernels, kAvx512Kernels;  // each in the file of its name

const CpuKernels* cpu_kernels(Isa isa) {
  switch (isa) {
    case Isa::avx2:
      return &kAvx2Kernels;
    case Isa::avx512:
    case Isa::amx:
      return &kAvx512Kernels;
    case Isa::ggml:
      break;
  }
  return nullptr;
}
#else
const CpuKernels* cpu_kernels(Isa) { return nullptr; }
#endif

const CpuKernels& portable_kernels() {
  static constexpr CpuKernels kernels = CpuKernelsMaker<Portable, 6>::make();
  return kernels;
}

}  // namespace vla::kernels
