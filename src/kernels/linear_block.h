// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>

#include "kernels/executor.h"
#include "kernels/linear_kernel.h"
#include "kernels/rounded.h"
#include "kernels/sizes.h"

namespace vla::kernels {

/// Two products on tiles; the second reads the first one's result. An item is a block of rows that passes through both.
/// The first one's result is stored in the thread's scratch memory from byte `inner` on, after the kernels' own part.
struct BlockedTask final : Task {
  const LinearKernel* kernel[2];
  LinearJob job[2];
  std::size_t inner;

  void run(std::int64_t item, Worker& worker) const override {
    const std::int64_t n_square = ceil_div(job[0].n_row, kTileSide);
    const std::int64_t first = n_square * item / n_item * kTileSide;
    const std::int64_t n = min(n_square * (item + 1) / n_item * kTileSide, job[0].n_row) - first;
    LinearJob up = rows_of(job[0], first, n), down = rows_of(job[1], first, n);
    // scratch_from makes each product discard kept scratch contents: jobs of other blocks had the same addresses.
    up.part[up.n_part - 1].y = worker.scratch_from(inner);
    run_all(*kernel[0], up, worker);
    down.x = worker.scratch_from(inner);
    run_all(*kernel[1], down, worker);
  }

 private:
  /// The job for n rows from `first` on. `first` is a multiple of kTileSide, because bf16 is stored in tiles.
  static LinearJob rows_of(LinearJob job, std::int64_t first, std::int64_t n) {
    const auto offset = [&](DType type, std::int64_t d, std::int64_t stride) {
      return type == DType::bf16 ? 2 * place_in_tiles(first, 0, d)
                                 : static_cast<std::int64_t>(dtype_size(type, first * stride));
    };
    job.n_row = n;
    job.x += offset(job.x_type, job.d_in, job.x_stride);
    for (LinearJob::Part& part : std::span(job.part, static_cast<std::size_t>(job.n_part))) {
      part.y += offset(part.y_type, part.d_out, part.d_out);
      if (part.residual != nullptr) part.residual += first * part.d_out;
    }
    return job;
  }

  static void run_all(const LinearKernel& kernel, LinearJob& job, Worker& worker) {
    const std::int64_t n = kernel.cut(job, 1);
    for (std::int64_t i = 0; i < n; ++i) kernel.run(job, i, worker);
  }
};

}  // namespace vla::kernels
