// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/machine_kernels.h"

namespace vla::kernels {

// Each is defined in the file of its name.
extern const LinearKernel kLinearNeonBf16, kLinearNeon;
extern const LinearKernel kTernaryI8mm, kTernaryDotprod, kInt4I8mm, kInt4Dotprod, kInt8I8mm, kInt8Dotprod;
extern const CpuKernels kNeonKernels;

namespace machine {

LinearKernels linear_kernels() {
  static constexpr const LinearKernel* kAll[] = {&kLinearNeonBf16, &kLinearNeon};
  return kAll;
}

LinearKernels ternary_kernels() {
  static constexpr const LinearKernel* kAll[] = {&kTernaryI8mm, &kTernaryDotprod};
  return kAll;
}

LinearKernels int4_kernels() {
  static constexpr const LinearKernel* kAll[] = {&kInt4I8mm, &kInt4Dotprod};
  return kAll;
}

LinearKernels int8_kernels() {
  static constexpr const LinearKernel* kAll[] = {&kInt8I8mm, &kInt8Dotprod};
  return kAll;
}

const CpuKernels* cpu_kernels(Features use) { return use.has(Feature::neon) ? &kNeonKernels : nullptr; }

}  // namespace machine
}  // namespace vla::kernels
