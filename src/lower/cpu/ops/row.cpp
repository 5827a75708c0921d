// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cpu/emit.h"

namespace vla::lower {
namespace {

/// Runs a row kernel on each row of x and of an optional second operand; the result is contiguous.
struct RowCalls {
  kernels::RowKernel kernel = nullptr;
  const float *x, *w, *b;
  float* y;
  Shape shape, x_stride, w_stride = {};
  float s = 0;
  bool w_is_scalar = false;  // one element of w per row

  void operator()(std::int64_t row) const {
    const std::int64_t i = row % shape[1], j = row / shape[1] % shape[2], k = row / shape[1] / shape[2];
    const float* w_row = w != nullptr ? w + i * w_stride[1] + j * w_stride[2] + k * w_stride[3] : nullptr;
    kernel(x + i * x_stride[1] + j * x_stride[2] + k * x_stride[3], w_row, b, w_is_scalar ? *w_row : s,
           y + row * shape[0], shape[0]);
  }
};

/// y = x + s
void add_scalar(const float* x, const float*, const float*, float s, float* y, std::int64_t n) {
  for (std::int64_t i = 0; i < n; ++i) y[i] = x[i] + s;
}

/// Selects the kernel, and how it reads the second operand.
struct SetRowKernel {
  const CpuLowering& l;
  const Value* w;
  RowCalls& row;

  void operator()(const op::Norm& norm) const { row.kernel = norm_kernel(l, norm), row.s = norm.eps; }
  void operator()(const op::Rope&) const { row.kernel = cpu(l).rotate_half, row.w_stride = {1, 0, row.shape[0], 0}; }
  void operator()(const op::Activate& op) const { row.kernel = cpu(l).activation(op.activation); }
  void operator()(const op::Scale& op) const { row.kernel = cpu(l).scale, row.s = op.factor; }
  void operator()(const op::Add&) const { broadcast(cpu(l).add, add_scalar); }
  void operator()(const op::Multiply&) const { broadcast(cpu(l).multiply, cpu(l).scale); }

 private:
  void broadcast(kernels::RowKernel of_rows, kernels::RowKernel of_scalars) const {
    row.w_stride = repeated_strides(*w);
    row.w_is_scalar = w->shape[0] == 1 && row.shape[0] != 1;
    row.kernel = row.w_is_scalar ? of_scalars : of_rows;
  }
};

}  // namespace

CpuRun run_of(const CpuLowering& l, const CpuOp& op, const RowOp& row) {
  const Shape& shape = row.node->shape;
  RowCalls calls = {.x = floats(l, row.x),
                    .w = floats(l, row.w),
                    .b = floats(l, row.b),
                    .y = floats(l, op.writes[0]),
                    .shape = shape,
                    .x_stride = l.value(row.x).stride};
  std::visit(SetRowKernel{l, row.w != kNone ? &l.value(row.w) : nullptr, calls}, row.what);
  const RowItems rows(l, rows_of(shape), shape[0]);
  const auto run = [=](std::int64_t item, Worker&) {
    for (std::int64_t i = rows.begin(item); i < rows.end(item); ++i) calls(i);
  };
  return {.kernel = name_of(l.use),
          .kind = std::holds_alternative<op::Norm>(row.what) ? KindClock::norms : KindClock::others,
          .scratch = 0,
          .task = task_of(rows.n_item, run)};
}

}  // namespace vla::lower
