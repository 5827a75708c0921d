// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>
#include <string>
#include <string_view>

#include "kernels/attention_kernel.h"
#include "kernels/executor.h"
#include "lower/cpu/cpu_lowering.h"

namespace vla::lower {

/// Keys and values as a kernel's job, without addresses.
kernels::PackJob pack_sizes(const CpuLowering& l, const PackOp& op);

/// A matrix, and where a task keeps its address.
struct MatrixUse {
  kernels::LinearJob::Part* part;
  const Param* matrix;
};
using MatrixUses = std::vector<MatrixUse>;
/// Makes the task that the executor runs for an operation, when every value has its address. Matrices get theirs before
/// each run: they are noted in `uses`.
std::unique_ptr<kernels::Task> emit(const CpuLowering& l, const CpuOp& op, MatrixUses& uses);

/// Bytes of scratch memory that a worker needs for it.
std::size_t scratch_of(const CpuLowering& l, const CpuOp& op);

/// Operations and bytes of an operation.
Work work_of(const CpuLowering& l, const CpuOp& op);
/// The kind that its time counts for. A norm that a product computes as it copies x is part of the product.
kernels::KindClock::Kind kind_of(const CpuOp& op);
/// One line: what is computed, the kernel, shapes and layouts.
std::string text_of(const CpuLowering& l, const CpuOp& op);
/// Such a line without the numbers that tell places apart: operations that share it take the same time.
std::string likeness_of(std::string_view text);

}  // namespace vla::lower
