// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/copy.h"

#include "lower/cpu/emit.h"

namespace vla::lower {

/// One item copies some rows of one part.
CpuRun run_of(const CpuLowering& l, const CpuOp& op, const CopyOp& copy) {
  struct Part {
    kernels::CopyJob job;
    RowItems rows;
    std::int64_t first_item;
  };
  std::vector<Part> parts;
  std::int64_t n_item = 0;
  for (const CopyOp::Part& part : copy.parts) {
    const kernels::CopyJob job = {reinterpret_cast<const std::uint32_t*>(address(l, part.from)) + part.from_offset,
                                  reinterpret_cast<std::uint32_t*>(address(l, op.writes[0])) + part.to_offset,
                                  part.shape, part.from_stride, part.to_stride};
    const RowItems rows(l, job.n_row(), job.shape[0]);
    parts.push_back({job, rows, n_item});
    n_item += rows.n_item;
  }
  const auto run = [parts = std::move(parts)](std::int64_t item, Worker&) {
    std::size_t i = parts.size() - 1;
    while (parts[i].first_item > item) --i;
    const std::int64_t of_part = item - parts[i].first_item;
    parts[i].job.copy_rows(parts[i].rows.begin(of_part), parts[i].rows.end(of_part));
  };
  return {.kernel = "copy", .kind = KindClock::others, .scratch = 0, .task = task_of(n_item, run)};
}

}  // namespace vla::lower
