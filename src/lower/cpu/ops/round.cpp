// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cpu/emit.h"

namespace vla::lower {

/// Quantizes rows of x to int8 codes and scales (kernels/quantized.h).
CpuRun run_of(const CpuLowering& l, const CpuOp& op, const RoundOp& round) {
  const Value& x = l.value(round.x);
  const kernels::LinearKernel& kernel = kernel_of(l, *round.product);
  const kernels::LinearJob::Norm norm = norm_of(l, round.norm, round.weight, round.bias);
  const float* const from = floats(l, round.x);
  std::byte* const codes = address(l, op.writes[0]);
  const std::int64_t d = x.shape[0], from_stride = row_stride(x), stride = row_stride(l.value(op.writes[0]));
  const RowItems rows(l, rows_of(x.shape), d);
  const auto quantize = [=, quantize_row = kernel.quantize](std::int64_t item, Worker& worker) {
    for (std::int64_t i = rows.begin(item); i < rows.end(item); ++i)
      quantize_row(norm(from + i * from_stride, d, worker.scratch<float>()), d, codes + i * stride);
  };
  return {.kernel = kernel.name,
          .kind = KindClock::norms,
          .scratch = round.norm != nullptr ? static_cast<std::size_t>(d) * sizeof(float) : 0,
          .task = task_of(rows.n_item, quantize)};
}

}  // namespace vla::lower
