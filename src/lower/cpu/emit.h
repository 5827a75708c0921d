// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>
#include <string>
#include <string_view>

#include "kernels/attention_kernel.h"
#include "kernels/cpu_kernels.h"
#include "kernels/executor.h"
#include "kernels/linear_kernel.h"
#include "lower/cpu/cpu_lowering.h"

namespace vla::lower {

using kernels::KindClock;
using kernels::Task;
using kernels::task_of;
using kernels::Worker;

/// A matrix, and the field of the task that holds its address.
struct MatrixUse {
  kernels::LinearJob::Part* part;
  const Param* matrix;
};
using MatrixUses = std::vector<MatrixUse>;

/// How the CPU runs an operation. Each file of lower/cpu/ops returns one.
#pragma GCC diagnostic error "-Wmissing-field-initializers"
struct CpuRun {
  std::string kernel;          // kernel name in a printed program
  KindClock::Kind kind;        // the clock that its time is added to
  std::size_t scratch;         // bytes of scratch memory per worker
  std::unique_ptr<Task> task;  // for the executor; all addresses are set except those of matrices
  MatrixUses matrices = {};    // matrices whose addresses are set before a run
};
/// Requires that every value has an address.
#define VLA_RUN_OP(Op) CpuRun run_of(const CpuLowering& l, const CpuOp& op, const Op& what);
VLA_LOWERED_OPS(VLA_RUN_OP)
VLA_RUN_OP(PackOp)
VLA_RUN_OP(BlockedOp)
#undef VLA_RUN_OP

/// FLOP and bytes of an operation.
Work work_of(const CpuLowering& l, const CpuOp& op);
/// Prints an operation: text, kernel, shapes and layouts.
std::string text_of(const CpuLowering& l, const CpuOp& op, const CpuRun& run);
/// The text without phase, layer and value numbers: operations with equal results take the same time.
std::string likeness_of(std::string_view text);

// Shared by the files of lower/cpu/ops.

/// Cuts rows into items for the threads.
struct RowItems {
  /// d: elements of a row.
  RowItems(const CpuLowering& l, std::int64_t n_row, std::int64_t d);

  std::int64_t begin(std::int64_t item) const { return item * n_each; }
  std::int64_t end(std::int64_t item) const { return std::min(n_row, (item + 1) * n_each); }

  std::int64_t n_row, n_each, n_item;
};

inline std::byte* address(const CpuLowering& l, ValueId id) {
  return l.address(l.value(id).base) + dtype_size(l.value(id).type, l.value(id).offset);
}
/// Null if the operand is missing.
inline float* floats(const CpuLowering& l, ValueId id) {
  return id != kNone ? reinterpret_cast<float*>(address(l, id)) : nullptr;
}
inline const kernels::CpuKernels& cpu(const CpuLowering& l) { return *kernels::cpu_kernels(l.use); }
inline const kernels::AttentionKernel& attention_kernel(const CpuLowering& l, bool rounds) {
  return kernels::cpu_kernels(l.features(rounds))->attention;
}
inline kernels::RowKernel norm_kernel(const CpuLowering& l, const op::Norm& norm) {
  return norm.kind == op::NormKind::rms ? cpu(l).rms_norm : cpu(l).layer_norm;
}
kernels::LinearJob::Norm norm_of(const CpuLowering& l, const Node* norm, ValueId weight, ValueId bias);
kernels::Window window_of(const Shape& x, const op::Window& window, const Shape& y);
/// The number of threads that share an operation of this many FLOP.
int threads_for(const CpuLowering& l, double flop);
/// A PackJob with its sizes but no addresses.
kernels::PackJob pack_sizes(const CpuLowering& l, const PackOp& op);
/// The job of a product, without the addresses of its matrices; `note_uses` lists the fields that hold these addresses.
kernels::LinearJob job_of(const CpuLowering& l, const CpuOp& op, const LinearOp& linear);
void note_uses(const LinearOp& linear, kernels::LinearJob& job, MatrixUses& uses);

}  // namespace vla::lower
