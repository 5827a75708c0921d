// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "base/activation.h"
#include "kernels/attention_kernel.h"
#include "kernels/channel_attention.h"
#include "kernels/kernel_set.h"

namespace vla::kernels {

/// Everything that is not a matrix product, for one instruction set. Rows are contiguous, and need no alignment.
struct CpuKernels {
  RowKernel silu, gelu_tanh, gelu_erf, relu, relu_squared;  // math.h, gelu_erf.h
  /// y = (x - mean) / sqrt(variance + s) * w + b, and y = x / sqrt(mean(x^2) + s) * w + b; w and b may be null.
  RowKernel layer_norm, rms_norm;
  /// Turns the pairs (x_i, x_{i + n/2}) by n/2 cosines in w and n/2 sines behind them.
  RowKernel rotate_half;
  RowKernel add, multiply;  // y = x + w, x * w
  RowKernel largest;        // y = the larger of x and w, NaN where one is
  RowKernel multiply_add;   // y = x * w + b
  RowKernel scale;          // y = x * s
  AttentionKernel attention;
  ChannelAttentionKernel channel_attention;

  RowKernel activation(Activation activation) const;
};

/// The kernels for what they may use; null where plain ggml operations are to be used. Those that round to bf16
/// (kernel_set.h) do so in attention too, with sums in float32, as PyTorch does with a bf16 model.
const CpuKernels* cpu_kernels(Features use);

}  // namespace vla::kernels
