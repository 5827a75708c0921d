// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "base/activation.h"
#include "cuda/kernels/launch.h"

namespace vla::cuda {

constexpr int kMostSplits = 8;  // shares of the depth that a kernel adds at once

/// Computes y from a product's sums: y = activation(sum + bias) * factor + residual, or the ReLU of that. With a gate,
/// y = activation(gate) * (sum + bias) * factor + residual. All operands except y may be null.
struct Epilogue {
  const float* bias;      // [n_column]
  const float* factor;    // [n_column]
  const float* gate;      // [n_column, n_row]
  const float* residual;  // [n_column, n_row]
  void* y;                // rows of n_column elements with a stride of y_stride elements
  std::int64_t y_stride;
  Activation activation;
  bool is_bf16;  // whether y is bf16, else float32
  bool ends_in_relu;
};

}  // namespace vla::cuda
