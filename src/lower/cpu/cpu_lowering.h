// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/rounded.h"
#include "lower/cpu/cpu_weights.h"
#include "lower/ops.h"

/// The passes of the CPU: a layout for every value, blocks of rows that stay in a cache, and a task for each operation.
namespace vla::lower {

struct CpuOp;
/// Two products, of which the second alone reads what the first makes, as in an MLP. A thread takes a block of rows
/// through both, so that the elements between them stay in its cache: memory of the thread is their home.
struct BlockedOp {
  std::vector<CpuOp> products;
  std::int64_t n_block;

  std::string text() const { return ""; }  // its products have theirs
  double flop() const;
};

struct CpuOp : Step {
  AnyOp<PackOp, BlockedOp> op;
};

struct CpuLowering : Lowering {
  const CpuWeights& weights;
  Features use;
  int n_thread;
  std::vector<CpuOp> ops = {};
  std::vector<std::byte*> data = {};  // of each base, when memory is there

  Features features(bool rounds) const { return rounds ? use : without_rounding(use); }
  std::byte* address(ValueId base) const { return data[static_cast<std::size_t>(base)]; }
};

inline kernels::RoundedLayout rounded(const Value& value) { return static_cast<kernels::RoundedLayout>(value.layout); }
/// The kernel that multiplies: all matrices of an operation have the same.
const kernels::LinearKernel& kernel_of(const CpuLowering& l, const Node& linear);

/// Chooses the dtype of values between products, makes codes of what those of codes read, and copies what its reader
/// needs contiguous.
void choose_layouts(CpuLowering& l, std::vector<FusedOp> ops);
/// Joins two products to one operation on blocks of rows where what lies between them would not stay in a cache.
void choose_blocks(CpuLowering& l);

}  // namespace vla::lower
