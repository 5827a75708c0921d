// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>

#include "bundle/bundle.h"
#include "kernels/cpu_kernels.h"
#include "kernels/turns.h"

namespace vla::kernels {

enum class Activation { none, gelu_tanh, gelu_erf, silu, relu };

/// One node of matrix products: what is multiplied, and where everything lies.
struct LinearJob {
  /// y = activation(W x + bias) + residual. y and residual are contiguous rows of d_out numbers, one for each row of x;
  /// bias and residual may be null.
  struct Part {
    DType type;               // of the stored weight
    const std::byte* weight;  // packed for its kernel
    const float* bias;
    const float* residual;
    std::byte* y;
    std::int64_t d_out;
  };
  static constexpr int kMaxPart = 3;

  /// y = run(x); null where x is multiplied as it is.
  struct Norm {
    CpuKernels::Norm run = nullptr;
    const float *weight = nullptr, *bias = nullptr;
    float eps = 0;
  };

  const std::byte* x;  // contiguous rows of d_in numbers
  Norm norm;           // what is multiplied is the norm of each row
  std::int64_t n_row, d_in;
  int n_part;
  Part part[kMaxPart];
  Activation activation;
  /// Two parts, gate and up, make one y, which is that of up: activation(gate) * up.
  bool gated;
  /// Of x and y: f32, or bf16 where the kernel rounds what it multiplies (LinearKernel::rounds).
  DType x_type, y_type;
  Turns* turns;  // of this node
};

}  // namespace vla::kernels
