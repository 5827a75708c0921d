// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>

#include "backend/matrix.h"
#include "kernels/linear_job.h"

namespace vla::kernels {

/// One implementation of the matrix product. Whatever it computes with, sums are float32.
struct LinearKernel : MatrixFormat {
  bool (*supports)(const MatrixDesc& desc, Isa isa);
  /// Thread `ith` of `nth` does its part of the job, with scratch memory of its own at a multiple of 64 bytes.
  void (*run)(const LinearJob& job, int ith, int nth, std::byte* scratch);
  std::size_t scratch_size;
  std::int64_t max_norm;  // the widest norm of x that it computes on the way
  /// Whether x of so many rows and this depth is rounded to bf16 once, so that it may come as bf16, and y may leave so.
  bool (*rounds)(std::int64_t n_row, std::int64_t d_in);
};

/// The implementations, best first. Behind the last stands ggml's product of float32, which takes everything that no
/// row takes, and which every row is tested against.
std::span<const LinearKernel* const> linear_kernels();

/// The first row that takes a matrix on a machine, or null for ggml: a ChooseFormat.
const MatrixFormat* choose_linear(const MatrixDesc& desc, Isa isa);

/// The same loop with tiles in plain C++, slow and for every machine: panels and edges stay tested where the
/// instructions are missing.
std::span<const LinearKernel* const> emulated_linear_kernels();

}  // namespace vla::kernels
