// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>

#include "base/activation.h"
#include "bundle/bundle.h"
#include "kernels/row_kernel.h"
#include "kernels/window.h"

namespace vla::kernels {

/// Matrix products of one x with their epilogues: operands and addresses.
struct LinearJob {
  /// y = activation(W x + bias) * factor + residual, or the ReLU of that. y and residual are contiguous rows of d_out
  /// elements, one per row of x. bias [d_out], factor [d_out] and residual may be null.
  struct Part {
    DType type;               // dtype of the stored weight
    const std::byte* weight;  // packed for its kernel
    const float* bias;
    const float* factor;
    const float* residual;
    std::byte* y;
    std::int64_t d_out;
    const float* scale = nullptr;  // one for a ternary weight; one per column for an int8 or int4 weight
    DType y_type = DType::f32;     // or bf16 in the layout of LinearKernel::rounded
  };
  static constexpr int kMaxPart = 3;

  /// The operation y = run(x) that comes before a product; null if x is multiplied as it is.
  struct Norm {
    RowKernel run = nullptr;
    const float *weight = nullptr, *bias = nullptr;
    float eps = 0;

    /// A row of n elements as the product reads it; `room` receives the norm if there is one.
    VLA_INLINE const float* operator()(const float* row, std::int64_t n, float* room) const {
      if (run == nullptr) return row;
      run(row, weight, bias, eps, room, n);
      return room;
    }
  };

  const std::byte* x;     // n_row rows of d_in elements
  std::int64_t x_stride;  // stride of rows in elements
  Norm norm;              // if set, the product reads the norm of each row
  Window window = {};     // if its size is not 0: a row is the window at one place of the images x, in float32
  std::int64_t n_row, d_in;
  int n_part;
  Part part[kMaxPart];
  Activation activation;
  bool ends_in_relu = false;  // applied after the residual
  /// If set, the two parts are gate and up, and activation(gate) * up is stored in the y of up.
  bool gated;
  /// f32; or bf16 in the layout of LinearKernel::rounded, if the kernel rounds its operands; or i8 rows of
  /// LinearKernel::quantize, x_stride bytes apart.
  DType x_type;
  // Set by LinearKernel::cut: groups of panels and, for tiles, blocks of rows of x.
  std::int64_t n_group, block_rows;
};

}  // namespace vla::kernels
