// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>

#include "kernels/executor.h"
#include "kernels/kernel_set.h"
#include "kernels/linear_job.h"
#include "kernels/rounded.h"

namespace vla::kernels {

/// A weight matrix: d_out consecutive rows of d_in elements, without scales.
struct MatrixDesc {
  DType type;
  std::int64_t d_in, d_out;
};

/// No limit for a depth.
constexpr std::int64_t kAnyDepth = std::int64_t{1} << 62;

/// One implementation of the matrix product. All of them sum in float32 or exact integers.
struct LinearKernel {
  const char* name;
  /// Bytes of the packed matrix.
  std::size_t (*packed_size)(const MatrixDesc& desc);
  /// `stored` and `packed` must be aligned to 32 and 64 bytes.
  void (*pack)(const MatrixDesc& desc, const std::byte* stored, std::byte* packed);
  bool (*supports)(const MatrixDesc& desc, Features use);
  /// Splits a job into items for that many threads. Returns the number of items.
  std::int64_t (*cut)(LinearJob& job, int n_thread);
  void (*run)(const LinearJob& job, std::int64_t item, Worker& worker);
  std::size_t scratch_size;
  std::int64_t max_norm;  // the widest norm of x that the product can compute itself
  /// The bf16 layout that x may have if the kernel would round x anyway, and that y may have if its reader would round
  /// y. Products deeper than max_rounded_depth store y as float32, because y holds their partial sums.
  RoundedLayout rounded = RoundedLayout::none;
  std::int64_t max_rounded_depth = 0;
  /// The kernel for at most `max_small_batch` rows, which reads the same packed matrix; null if this one computes them
  /// too.
  const LinearKernel* small_batch = nullptr;
  std::int64_t max_small_batch = 0;
  /// Writes n elements of x as a row of int8 codes (quantized.h), if the kernel needs such rows. Else null.
  void (*quantize)(const float* x, std::int64_t n, std::byte* row) = nullptr;
  /// How many elements of x stay in L2 while weights pass through it, for kernels that read x in place; 0 for kernels
  /// that copy x first.
  std::int64_t l2_elements = 0;
  bool takes_windows = false;  // x may be images under a window

  const LinearKernel& for_batch(std::int64_t n_row) const { return n_row <= max_small_batch ? *small_batch : *this; }
  RoundedLayout y_layout(std::int64_t d_in) const { return d_in <= max_rounded_depth ? rounded : RoundedLayout::none; }
};

/// The implementations, best first.
std::span<const LinearKernel* const> linear_kernels();

/// The first kernel of the table that supports this matrix and needs no other features, or null.
const LinearKernel* choose_linear(const MatrixDesc& desc, Features use);

}  // namespace vla::kernels
