// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/machine_kernels.h"

namespace vla::kernels {

// Each is defined in the file of its name.
extern const LinearKernel kLinearAmx, kLinearAvx512Bf16, kLinearAvx512, kLinearAvx2;
extern const LinearKernel kTernaryAmx, kTernaryLookup, kTernaryAvx512, kTernaryAvxVnni, kTernaryAvx2;
extern const LinearKernel kInt4Amx, kInt4Avx512, kInt4AvxVnni, kInt4Avx2;
extern const LinearKernel kInt8Amx, kInt8Avx512, kInt8AvxVnni, kInt8Avx2;
extern const CpuKernels kAvx2Kernels, kAvx512Kernels;
extern const AttentionKernel kAttentionAvx512Bf16, kAttentionAmx;

namespace machine {
namespace {

CpuKernels avx512_with(const AttentionKernel& attention) {
  CpuKernels kernels = kAvx512Kernels;
  kernels.attention = attention;
  return kernels;
}

}  // namespace

LinearKernels linear_kernels() {
  static constexpr const LinearKernel* kAll[] = {&kLinearAmx, &kLinearAvx512Bf16, &kLinearAvx512, &kLinearAvx2};
  return kAll;
}

LinearKernels ternary_kernels() {
  static constexpr const LinearKernel* kAll[] = {&kTernaryAmx, &kTernaryLookup, &kTernaryAvx512, &kTernaryAvxVnni,
                                                 &kTernaryAvx2};
  return kAll;
}

LinearKernels int4_kernels() {
  static constexpr const LinearKernel* kAll[] = {&kInt4Amx, &kInt4Avx512, &kInt4AvxVnni, &kInt4Avx2};
  return kAll;
}

LinearKernels int8_kernels() {
  static constexpr const LinearKernel* kAll[] = {&kInt8Amx, &kInt8Avx512, &kInt8AvxVnni, &kInt8Avx2};
  return kAll;
}

const CpuKernels* cpu_kernels(Features use) {
  static const CpuKernels avx512_bf16 = avx512_with(kAttentionAvx512Bf16), amx = avx512_with(kAttentionAmx);
  if (use.has(Feature::amx_bf16)) return &amx;
  if (use.has(Feature::avx512_bf16)) return &avx512_bf16;
  if (use.has(Feature::avx512)) return &kAvx512Kernels;
  return use.has(Feature::avx2) ? &kAvx2Kernels : nullptr;
}

}  // namespace machine
}  // namespace vla::kernels
