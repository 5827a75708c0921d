// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/int8_kernels.h"

namespace vla::kernels {

#if defined(__x86_64__)
// Each in the file of its name.
extern const LinearKernel kLinearAmx, kLinearAvx512Bf16, kLinearAvx512, kLinearAvx2;
extern const LinearKernel kTernaryAmx, kTernaryLookup, kTernaryAvx512, kTernaryAvxVnni, kTernaryAvx2;
extern const LinearKernel kInt8Amx, kInt8Avx512, kInt8AvxVnni, kInt8Avx2;
#endif
extern const LinearKernel kTernaryPlain, kInt8Plain;  // int8_emulated.cpp

std::span<const LinearKernel* const> linear_kernels() {
#if defined(__x86_64__)
  static constexpr const LinearKernel* kAll[] = {&kLinearAmx, &kLinearAvx512Bf16, &kLinearAvx512, &kLinearAvx2};
  return kAll;
#else
  return {};
#endif
}

const LinearKernel* choose_linear(const MatrixDesc& desc, Features use) {
  const auto kernels = desc.type == DType::ternary ? ternary_kernels()
                       : desc.type == DType::i8    ? int8_kernels()
                                                   : linear_kernels();
  for (const LinearKernel* kernel : kernels)
    if (kernel->supports(desc, use)) return kernel;
  return nullptr;
}

std::span<const LinearKernel* const> ternary_kernels() {
#if defined(__x86_64__)
  static constexpr const LinearKernel* kAll[] = {&kTernaryAmx,     &kTernaryLookup, &kTernaryAvx512,
                                                 &kTernaryAvxVnni, &kTernaryAvx2,   &kTernaryPlain};
#else
  static constexpr const LinearKernel* kAll[] = {&kTernaryPlain};
#endif
  return kAll;
}

std::span<const LinearKernel* const> int8_kernels() {
#if defined(__x86_64__)
  static constexpr const LinearKernel* kAll[] = {&kInt8Amx, &kInt8Avx512, &kInt8AvxVnni, &kInt8Avx2, &kInt8Plain};
#else
  static constexpr const LinearKernel* kAll[] = {&kInt8Plain};
#endif
  return kAll;
}

}  // namespace vla::kernels
