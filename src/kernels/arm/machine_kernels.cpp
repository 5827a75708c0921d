// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/machine_kernels.h"

namespace vla::kernels {

// Each in the file of its name.
extern const LinearKernel kLinearNeon, kTernaryDotprod, kInt4Dotprod, kInt8Dotprod;
extern const CpuKernels kNeonKernels;

namespace machine {

LinearKernels linear_kernels() {
  static constexpr const LinearKernel* kAll[] = {&kLinearNeon};
  return kAll;
}

LinearKernels ternary_kernels() {
  static constexpr const LinearKernel* kAll[] = {&kTernaryDotprod};
  return kAll;
}

LinearKernels int4_kernels() {
  static constexpr const LinearKernel* kAll[] = {&kInt4Dotprod};
  return kAll;
}

LinearKernels int8_kernels() {
  static constexpr const LinearKernel* kAll[] = {&kInt8Dotprod};
  return kAll;
}

const CpuKernels* cpu_kernels(Features use) { return use.has(Feature::neon) ? &kNeonKernels : nullptr; }

}  // namespace machine
}  // namespace vla::kernels
