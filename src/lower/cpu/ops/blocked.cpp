// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/linear_block.h"
#include "lower/cpu/emit.h"

namespace vla::lower {

CpuRun run_of(const CpuLowering& l, const CpuOp&, const BlockedOp& blocked) {
  auto task = std::make_unique<kernels::BlockedTask>();
  MatrixUses uses;
  for (std::size_t i = 0; i < 2; ++i) {
    const auto& linear = std::get<LinearOp>(blocked.products[i].op);
    task->kernel[i] = &kernel_of(l, *linear.linears[0]), task->job[i] = job_of(l, blocked.products[i], linear);
    note_uses(linear, task->job[i], uses);
  }
  // A thread's scratch memory holds the kernels' own scratch, then the intermediate elements of its block.
  const Value& inner = l.value(blocked.products[0].writes[0]);
  const std::int64_t d = inner.shape[0], n_square = kernels::ceil_div(rows_of(inner.shape), kernels::kTileSide);
  const std::int64_t n_row = kernels::ceil_div(n_square, blocked.n_block) * kernels::kTileSide;
  task->inner = aligned(std::max(task->kernel[0]->scratch_size, task->kernel[1]->scratch_size));
  const std::size_t size = 2 * static_cast<std::size_t>(kernels::rounded_count(rounded(inner), n_row, d));
  task->n_item = blocked.n_block;
  return {.kernel = task->kernel[0]->name,
          .kind = KindClock::products,
          .scratch = task->inner + size,
          .task = std::move(task),
          .matrices = std::move(uses)};
}

}  // namespace vla::lower
