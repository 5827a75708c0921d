// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "base/activation.h"
#include "kernels/attention_kernel.h"
#include "kernels/channel_attention.h"
#include "kernels/kernel_set.h"

namespace vla::kernels {

/// Everything except matrix products, for one instruction set. Rows are contiguous and need no alignment.
struct CpuKernels {
  RowKernel silu, gelu_tanh, gelu_erf, relu, relu_squared, mish;  // math.h, gelu_erf.h
  /// y = (x - mean) / sqrt(variance + s) * w + b, and y = x / sqrt(mean(x^2) + s) * w + b; w and b may be null.
  RowKernel layer_norm, rms_norm;
  /// Rotates the pairs (x_i, x_{i + n/2}); w has n/2 cosines followed by n/2 sines.
  RowKernel rotate_half;
  RowKernel add, multiply;  // y = x + w, x * w
  RowKernel largest;        // y = max(x, w), NaN if either is NaN
  RowKernel multiply_add;   // y = x * w + b
  RowKernel scale;          // y = x * s
  AttentionKernel attention;
  ChannelAttentionKernel channel_attention;

  RowKernel activation(Activation activation) const;
};

/// The kernels for these features; null for the set `ggml`, which uses ggml's operations. Kernels that round to bf16
/// (kernel_set.h) also round in attention, with sums in float32, like PyTorch with a bf16 model.
const CpuKernels* cpu_kernels(Features use);

}  // namespace vla::kernels
