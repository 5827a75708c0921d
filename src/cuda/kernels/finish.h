// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/kernels/device.h"
#include "cuda/kernels/epilogue.h"

namespace vla::cuda {

/// Within a few units in the last place. Written without a switch, because nvcc would build a jump table at every use.
/// Sources: torch silu, gelu, relu.
VLA_DEVICE float activate(Activation activation, float x) {
  if (activation == Activation::none) return x;
  if (activation == Activation::gelu_erf) return 0.5f * x * (1 + erff(0.70710678f * x));
  if (activation == Activation::relu) return x < 0 ? 0 : x;
  if (activation == Activation::relu_squared) return x < 0 ? 0 : x * x;
  // x / (1 + e^-u). With u = x this is SiLU; since 1 + tanh(u / 2) = 2 / (1 + e^-u), it also gives GELU's tanh form.
  const float u = activation == Activation::silu ? x : 1.5957691216f * (x + 0.044715f * x * x * x);
  return x / (1 + expf(-u));
}

/// y of one sum. Products and sums are not fused, so y without an activation equals the CPU's to the bit.
VLA_DEVICE float finish(const Epilogue& e, float sum, std::int64_t row, int column, int n_column) {
  const std::int64_t at = row * n_column + column;
  if (e.bias) sum = dev::add(sum, e.bias[column]);
  sum = e.gate ? dev::multiply(activate(e.activation, e.gate[at]), sum) : activate(e.activation, sum);
  if (e.factor) sum = dev::multiply(sum, e.factor[column]);
  if (e.residual) sum = dev::add(sum, e.residual[at]);
  return e.ends_in_relu ? activate(Activation::relu, sum) : sum;
}

/// Stores y of two adjacent sums; the second may be after the last column.
VLA_DEVICE void finish_pair(const Epilogue& e, float first, float second, std::int64_t row, int column, int n_column) {
  const bool has_second = column + 1 < n_column;
  first = finish(e, first, row, column, n_column);
  second = has_second ? finish(e, second, row, column + 1, n_column) : 0;
  const std::int64_t at = row * e.y_stride + column;
  const bool together = has_second && e.y_stride % 2 == 0;
  if (e.is_bf16) {
    const unsigned pair = dev::to_bf16(first, second);
    auto* y = static_cast<std::uint16_t*>(e.y) + at;
    if (together) {
      *reinterpret_cast<unsigned*>(y) = pair;
    } else {
      y[0] = static_cast<std::uint16_t>(pair);
      if (has_second) y[1] = static_cast<std::uint16_t>(pair >> 16);
    }
  } else {
    auto* y = static_cast<float*>(e.y) + at;
    if (together) {
      *reinterpret_cast<float2*>(y) = float2{first, second};
    } else {
      y[0] = first;
      if (has_second) y[1] = second;
    }
  }
}

}  // namespace vla::cuda
