// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/cpu_kernels.h"

#include "kernels/machine_kernels.h"

namespace vla::kernels {

RowKernel CpuKernels::activation(Activation activation) const {
  switch (activation) {
    case Activation::gelu_tanh:
      return gelu_tanh;
    case Activation::gelu_erf:
      return gelu_erf;
    case Activation::silu:
      return silu;
    case Activation::relu:
      return relu;
    case Activation::relu_squared:
      return relu_squared;
    case Activation::mish:
      return mish;
    case Activation::none:
      break;
  }
  return nullptr;
}

extern const CpuKernels kPortableKernels;  // portable/cpu_kernels_portable.cpp

const CpuKernels* cpu_kernels(Features use) {
  if (const CpuKernels* kernels = machine::cpu_kernels(use)) return kernels;
  return use.has(Feature::baseline) ? &kPortableKernels : nullptr;
}

}  // namespace vla::kernels
