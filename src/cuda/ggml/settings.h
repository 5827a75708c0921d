// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// Included before every CUDA source of ggml by the compiler's command line, so that ggml itself is unchanged. It fixes
// what changes numbers: products are computed in the type of their weights on the device.
#pragma once

#include <cublas_v2.h>

#include <cstdlib>
#include <cstring>

/// Replaces the environment that ggml reads, except for the type of products.
inline char* vla_cuda_setting(const char* name) {
  static char of_weights[] = "auto";
  return std::strcmp(name, "GGML_CUDA_CUBLAS_COMPUTE_TYPE") == 0 ? of_weights : std::getenv(name);
}
#define getenv(name) vla_cuda_setting(name)

// ggml lets cuBLAS round the operands of float32 products to TF32, 10 bits of mantissa.
#define CUBLAS_TF32_TENSOR_OP_MATH CUBLAS_DEFAULT_MATH
