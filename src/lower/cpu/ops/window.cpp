// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cpu/emit.h"

namespace vla::lower {

/// Copies the elements under a window, or takes their maximum, or their weighted sum. One item computes one row of
/// places.
CpuRun run_of(const CpuLowering& l, const CpuOp& op, const WindowOp& at) {
  const Shape& places = at.node->shape;
  const kernels::Window window = window_of(at.node->in[0].shape(), at.window, places);
  const kernels::RowKernel largest = at.takes_largest ? cpu(l).largest : nullptr;
  const kernels::RowKernel multiply_add = at.weight != kNone ? cpu(l).multiply_add : nullptr;
  const bool copies = largest == nullptr && multiply_add == nullptr;
  const float *const x = floats(l, at.x), *const weight = floats(l, at.weight), *const bias = floats(l, at.bias);
  float* const y = floats(l, op.writes[0]);
  const std::int64_t d = places[0];
  const auto run = [=](std::int64_t row, Worker&) {
    for (std::int64_t place = row * window.n_column; place < (row + 1) * window.n_column; ++place) {
      if (copies)
        window.copy(x, place, 0, d, y + place * d);
      else if (largest != nullptr)
        window.largest(largest, x, place, y + place * d);
      else
        window.weigh(multiply_add, x, weight, bias, place, y + place * d);
    }
  };
  return {.kernel = copies ? "copy" : name_of(l.use),
          .kind = KindClock::others,
          .scratch = 0,
          .task = task_of(places[2] * places[3], run)};
}

}  // namespace vla::lower
