// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// The compiler's command line includes this file before every CUDA source of ggml, so that ggml itself is unchanged. It
// fixes the settings that change numbers: products are computed in the type that their weights have on the device.
#pragma once

#include <cublas_v2.h>

#include <cstdlib>
#include <cstring>

/// Replaces getenv in ggml: fixes the type of products and passes every other variable through.
inline char* vla_cuda_setting(const char* name) {
  static char of_weights[] = "auto";
  return std::strcmp(name, "GGML_CUDA_CUBLAS_COMPUTE_TYPE") == 0 ? of_weights : std::getenv(name);
}
#define getenv(name) vla_cuda_setting(name)

// ggml lets cuBLAS round the operands of float32 products to TF32, 10 bits of mantissa.
#define CUBLAS_TF32_TENSOR_OP_MATH CUBLAS_DEFAULT_MATH
