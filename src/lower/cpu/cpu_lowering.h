// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/rounded.h"
#include "lower/cpu/cpu_weights.h"
#include "lower/ops.h"

/// The CPU's passes: choose each value's layout, join products into cache-sized blocks of rows, make a task for each
/// operation.
namespace vla::lower {

struct CpuOp;
/// Two products, as in an MLP, where only the second reads the result of the first. A thread computes both products for
/// one block of rows, so that the intermediate elements stay in its cache, in its own scratch memory.
struct BlockedOp {
  std::vector<CpuOp> products;
  std::int64_t n_block;

  // Each product prints its own line and counts its own work.
  std::string text() const { return ""; }
  double flop() const { return 0; }
};

struct CpuOp : Step {
  AnyOp<PackOp, BlockedOp> op;
};

struct CpuLowering : Lowering {
  const CpuWeights& weights;
  Features use;
  int n_thread;
  std::vector<CpuOp> ops = {};
  std::vector<std::byte*> data = {};  // address of each base, once memory is allocated

  Features features(bool rounds) const { return rounds ? use : without_rounding(use); }
  std::byte* address(ValueId base) const { return data[static_cast<std::size_t>(base)]; }
};

inline kernels::RoundedLayout rounded(const Value& value) { return static_cast<kernels::RoundedLayout>(value.layout); }
/// Returns the kernel that multiplies by this node's matrix; all matrices of an operation use the same one.
const kernels::LinearKernel& kernel_of(const CpuLowering& l, const Node& linear);

/// Chooses the dtype of values between products, quantizes the inputs of int8 products, and copies operands that must
/// be contiguous.
void choose_layouts(CpuLowering& l, std::vector<FusedOp> ops);
/// Joins two products into one operation on blocks of rows if the value between them would not stay in a cache.
void choose_blocks(CpuLowering& l);

}  // namespace vla::lower
