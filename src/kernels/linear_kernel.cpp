// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/linear_kernel.h"

namespace vla::kernels {

#if defined(__x86_64__)
extern const LinearKernel kLinearAmx, kLinearAvx512Bf16, kLinearAvx512, kLinearAvx2;  // each in the file of its name
#endif

std::span<const LinearKernel* const> linear_kernels() {
#if defined(__x86_64__)
  static constexpr const LinearKernel* kAll[] = {&kLinearAmx, &kLinearAvx512Bf16, &kLinearAvx512, &kLinearAvx2};
  return kAll;
#else
  return {};
#endif
}

const LinearKernel* choose_linear(const MatrixDesc& desc, Isa isa) {
  for (const LinearKernel* kernel : linear_kernels())
    if (kernel->supports(desc, isa)) return kernel;
  return nullptr;
}

}  // namespace vla::kernels
