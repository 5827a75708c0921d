// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "backend/isa.h"
#include "kernels/attention_kernel.h"

namespace vla::kernels {

/// Everything that is not a matrix product, for one instruction set. Rows are contiguous, and need no alignment.
struct CpuKernels {
  using Map = void (*)(const float* x, float* y, std::int64_t n);
  /// y = (x - mean) / deviation * weight + bias; weight and bias may be null.
  using Norm = void (*)(const float* x, const float* weight, const float* bias, float eps, float* y, std::int64_t n);

  Map silu, gelu_tanh, gelu_erf, relu;  // math.h, gelu_erf.h
  Norm layer_norm, rms_norm;
  /// Turns the pairs (x_i, x_{i + half}).
  void (*rotate_half)(const float* x, const float* cosine, const float* sine, float* y, std::int64_t half);
  AttentionKernel attention;
};

/// The kernels of `isa`, which the machine must have; null where plain ggml operations are to be used. Those of `amx`
/// multiply bf16 in attention, with sums in float32, as PyTorch does with a bf16 model.
const CpuKernels* cpu_kernels(Isa isa);

/// The same templates without any instruction set: slow, and there to test them at another width.
const CpuKernels& portable_kernels();
/// Attention with numbers rounded to bf16, as AMX multiplies them, in plain C++: for tests on machines without AMX.
const AttentionKernel& emulated_amx_attention();

}  // namespace vla::kernels
