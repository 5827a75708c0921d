// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>

#include "kernels/attention_kernel.h"
#include "kernels/executor.h"
#include "lower/kind_clock.h"
#include "lower/lowering.h"

namespace vla::lower {

/// Keys and values as a kernel's job, without addresses.
kernels::PackJob pack_sizes(const Lowering& l, const PackOp& op);

/// What the executor runs for an operation, when every value has its address.
std::unique_ptr<kernels::Task> emit(const Lowering& l, const FusedOp& op);

/// Bytes of scratch memory that a worker needs for it.
std::size_t scratch_of(const Lowering& l, const FusedOp& op);

/// Operations and bytes of an operation.
Work work_of(const Lowering& l, const FusedOp& op);
/// What its time counts for. A norm that a product computes as it copies x is part of the product.
KindClock::Kind kind_of(const FusedOp& op);
/// One line: what is computed, the kernel, shapes and layouts.
std::string text_of(const Lowering& l, const FusedOp& op);

}  // namespace vla::lower
