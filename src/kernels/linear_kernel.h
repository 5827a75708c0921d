// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>

#include "kernels/executor.h"
#include "kernels/kernel_set.h"
#include "kernels/linear_job.h"
#include "kernels/rounded.h"

namespace vla::kernels {

/// A weight matrix: d_out rows of d_in elements, one row after the other. Scales of codes are no part of it.
struct MatrixDesc {
  DType type;
  std::int64_t d_in, d_out;
};

/// No limit of a depth.
constexpr std::int64_t kAnyDepth = std::int64_t{1} << 62;

/// One implementation of the matrix product. Whatever it computes with, sums are float32.
struct LinearKernel {
  const char* name;
  /// Bytes of the packed matrix.
  std::size_t (*packed_size)(const MatrixDesc& desc);
  /// `stored` and `packed` start at multiples of 32 and 64 bytes.
  void (*pack)(const MatrixDesc& desc, const std::byte* stored, std::byte* packed);
  bool (*supports)(const MatrixDesc& desc, Features use);
  /// Cuts a job into items for so many threads, and says how many there are.
  std::int64_t (*cut)(LinearJob& job, int n_thread);
  void (*run)(const LinearJob& job, std::int64_t item, Worker& worker);
  std::size_t scratch_size;
  std::int64_t max_norm;  // the widest norm of x that it computes on the way
  /// How x may come, where the kernel would round it to bf16, and y leave, where who reads it would: y of products up
  /// to this depth, as partial sums of deeper ones lie in y.
  RoundedLayout rounded = RoundedLayout::none;
  std::int64_t max_rounded_depth = 0;
  /// The kernel for products of at most `max_small_batch` rows, from the same packed matrix; null where this one
  /// computes them.
  const LinearKernel* small_batch = nullptr;
  std::int64_t max_small_batch = 0;
  /// Makes a row of int8 codes (quantized.h) of n elements of x, where x must come as such rows. Else null.
  void (*quantize)(const float* x, std::int64_t n, std::byte* row) = nullptr;
  /// Elements of x that the L2 cache keeps beside what passes through it, where x is read as the product before left
  /// it; 0 where it is copied first.
  std::int64_t l2_elements = 0;
  bool takes_windows = false;  // x may be images under a window

  const LinearKernel& for_batch(std::int64_t n_row) const { return n_row <= max_small_batch ? *small_batch : *this; }
  RoundedLayout y_layout(std::int64_t d_in) const { return d_in <= max_rounded_depth ? rounded : RoundedLayout::none; }
};

/// The implementations, best first.
std::span<const LinearKernel* const> linear_kernels();

/// The first row that takes a matrix with no more than these features, or null.
const LinearKernel* choose_linear(const MatrixDesc& desc, Features use);

}  // namespace vla::kernels
