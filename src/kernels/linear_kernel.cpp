// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <vector>

#include "kernels/int8_kernels.h"
#include "kernels/machine_kernels.h"

namespace vla::kernels {

extern const LinearKernel kLinearPortable, kTernaryPortable, kInt4Portable,
    kInt8Portable;  // each is defined in the file of its name

namespace {

std::vector<const LinearKernel*> with(machine::LinearKernels kernels, const LinearKernel& portable) {
  std::vector<const LinearKernel*> all(kernels.begin(), kernels.end());
  all.push_back(&portable);
  return all;
}

}  // namespace

std::span<const LinearKernel* const> linear_kernels() {
  static const auto all = with(machine::linear_kernels(), kLinearPortable);
  return all;
}

std::span<const LinearKernel* const> ternary_kernels() {
  static const auto all = with(machine::ternary_kernels(), kTernaryPortable);
  return all;
}

std::span<const LinearKernel* const> int4_kernels() {
  static const auto all = with(machine::int4_kernels(), kInt4Portable);
  return all;
}

std::span<const LinearKernel* const> int8_kernels() {
  static const auto all = with(machine::int8_kernels(), kInt8Portable);
  return all;
}

const LinearKernel* choose_linear(const MatrixDesc& desc, Features use) {
  const auto kernels = desc.type == DType::ternary ? ternary_kernels()
                       : desc.type == DType::int4  ? int4_kernels()
                       : desc.type == DType::i8    ? int8_kernels()
                                                   : linear_kernels();
  for (const LinearKernel* kernel : kernels)
    if (kernel->supports(desc, use)) return kernel;
  return nullptr;
}

}  // namespace vla::kernels
