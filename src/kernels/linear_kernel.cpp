// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/ternary_kernels.h"

namespace vla::kernels {

#if defined(__x86_64__)
// Each in the file of its name.
extern const LinearKernel kLinearAmx, kLinearAvx512Bf16, kLinearAvx512, kLinearAvx2;
extern const LinearKernel kTernaryAmx, kTernaryAvx512, kTernaryAvxVnni, kTernaryAvx2;
#endif
extern const LinearKernel kTernaryPlain;  // ternary_emulated.cpp

std::span<const LinearKernel* const> linear_kernels() {
#if defined(__x86_64__)
  static constexpr const LinearKernel* kAll[] = {&kLinearAmx, &kLinearAvx512Bf16, &kLinearAvx512, &kLinearAvx2};
  return kAll;
#else
  return {};
#endif
}

const LinearKernel* choose_linear(const MatrixDesc& desc, Isa isa) {
  for (const LinearKernel* kernel : desc.type == DType::i8 ? ternary_kernels() : linear_kernels())
    if (kernel->supports(desc, isa)) return kernel;
  return nullptr;
}

std::span<const LinearKernel* const> ternary_kernels() {
#if defined(__x86_64__)
  static constexpr const LinearKernel* kAll[] = {&kTernaryAmx, &kTernaryAvx512, &kTernaryAvxVnni, &kTernaryAvx2,
                                                 &kTernaryPlain};
#else
  static constexpr const LinearKernel* kAll[] = {&kTernaryPlain};
#endif
  return kAll;
}

}  // namespace vla::kernels
