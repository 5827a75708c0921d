// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cpu/emit.h"

namespace vla::lower {
namespace {

struct LinearTask final : Task {
  LinearTask(const kernels::LinearKernel& of, const kernels::LinearJob& what) : kernel(of), job(what) {}
  void run(std::int64_t item, Worker& worker) const override { kernel.run(job, item, worker); }

  const kernels::LinearKernel& kernel;
  kernels::LinearJob job;
};

}  // namespace

kernels::LinearJob job_of(const CpuLowering& l, const CpuOp& op, const LinearOp& linear) {
  kernels::LinearJob job = {};
  const Value& x = l.value(linear.x);
  job.x = address(l, linear.x), job.x_type = x.type, job.x_stride = row_stride(x);
  const Shape& rows = linear.unfold != nullptr ? linear.unfold->shape : x.shape;
  job.d_in = rows[0], job.n_row = rows_of(rows);
  if (linear.unfold != nullptr) job.window = window_of(x.shape, linear.unfold->as<op::Unfold>()->window, rows);
  job.activation = linear.activation, job.gated = linear.gated, job.ends_in_relu = linear.ends_in_relu;
  job.norm = norm_of(l, linear.norm, linear.norm_weight, linear.norm_bias);
  for (const Node* node : linear.linears) {
    const auto& product = *node->as<op::Linear>();
    kernels::LinearJob::Part& part = job.part[job.n_part++];
    part.type = l.weights.encoding(product.weight).type;
    part.bias = product.bias != nullptr ? l.weights.floats(product.bias) : nullptr;
    part.d_out = product.weight->shape[1];
    // A gated MLP has one output, stored in the part of its up matrix, the last one.
    const ValueId y = op.writes[linear.gated ? 0 : static_cast<std::size_t>(job.n_part - 1)];
    part.y = address(l, y), part.y_type = l.value(y).type;
  }
  kernels::LinearJob::Part& last = job.part[job.n_part - 1];
  last.factor = floats(l, linear.factor), last.residual = floats(l, linear.residual);
  return job;
}

void note_uses(const LinearOp& linear, kernels::LinearJob& job, MatrixUses& uses) {
  for (std::size_t i = 0; i < linear.linears.size(); ++i)
    uses.push_back({&job.part[i], linear.linears[i]->as<op::Linear>()->weight});
}

CpuRun run_of(const CpuLowering& l, const CpuOp& op, const LinearOp& linear) {
  const kernels::LinearKernel& kernel = kernel_of(l, *linear.linears[0]);
  auto task = std::make_unique<LinearTask>(kernel, job_of(l, op, linear));
  task->n_item = kernel.cut(task->job, threads_for(l, linear.flop()));
  MatrixUses uses;
  note_uses(linear, task->job, uses);
  return {.kernel = kernel.name,
          .kind = KindClock::products,
          .scratch = kernel.scratch_size,
          .task = std::move(task),
          .matrices = std::move(uses)};
}

}  // namespace vla::lower
