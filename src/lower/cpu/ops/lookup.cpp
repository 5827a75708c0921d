// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <cstring>

#include "kernels/numbers.h"
#include "lower/cpu/emit.h"
#include "lower/cpu/table_rows.h"

namespace vla::lower {
namespace {

/// Copies rows of a parameter and widens them to float32 in place: a row of two-byte elements is first read into the
/// second half of its destination.
std::unique_ptr<Task> embed(const CpuLowering& l, const Param* param, const std::int32_t* ids, float* y, std::int64_t d,
                            std::int64_t n) {
  TableRows* const table = l.weights.rows(param);
  return task_of(1, [=, type = param->encoding.type](std::int64_t, Worker&) {
    for (std::int64_t i = 0; i < n; ++i) {
      float* const to = y + i * d;
      std::byte* const stored = reinterpret_cast<std::byte*>(to + d) - table->row_size();
      table->copy(ids[i], stored);
      for (std::int64_t j = 0; type != DType::f32 && j < d; ++j) to[j] = kernels::stored_number(type, stored, j);
    }
  });
}

/// Copies rows of a value.
std::unique_ptr<Task> gather(const CpuLowering& l, ValueId table, const std::int32_t* ids, float* y, std::int64_t d,
                             std::int64_t n) {
  const RowItems items(l, n, d);
  return task_of(items.n_item,
                 [=, from = floats(l, table), stride = l.value(table).stride[1]](std::int64_t item, Worker&) {
                   for (std::int64_t i = items.begin(item); i < items.end(item); ++i)
                     std::memcpy(y + i * d, from + ids[i] * stride, static_cast<std::size_t>(d) * sizeof(float));
                 });
}

}  // namespace

CpuRun run_of(const CpuLowering& l, const CpuOp& op, const LookupOp& lookup) {
  const Shape& shape = lookup.node->shape;
  const auto* embedding = lookup.node->as<op::Embedding>();
  const auto* ids = reinterpret_cast<const std::int32_t*>(address(l, lookup.ids));
  float* const y = floats(l, op.writes[0]);
  return {.kernel = "copy",
          .kind = KindClock::others,
          .scratch = 0,
          .task = embedding != nullptr ? embed(l, embedding->table, ids, y, shape[0], shape[1])
                                       : gather(l, lookup.table, ids, y, shape[0], shape[1])};
}

}  // namespace vla::lower
