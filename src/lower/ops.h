// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <concepts>
#include <variant>

#include "lower/ops/attention.h"
#include "lower/ops/channel_attention.h"
#include "lower/ops/copy.h"
#include "lower/ops/linear.h"
#include "lower/ops/lookup.h"
#include "lower/ops/round.h"
#include "lower/ops/row.h"
#include "lower/ops/window.h"

/// The operations that every target runs. A file of lower/ops declares each with its needs; a file of lower/cpu/ops and
/// one of lower/cuda/ops say how a target runs it.
#define VLA_LOWERED_OPS(OP) \
  OP(LinearOp) OP(RoundOp) OP(AttentionOp) OP(RowOp) OP(CopyOp) OP(LookupOp) OP(WindowOp) OP(ChannelOp)

namespace vla::lower {

template <class Op>
concept LoweredOp = requires(Op op, const Op& same) {
  { op.operands() } -> std::same_as<Operands>;   // the values it reads, and their layout needs
  { same.text() } -> std::same_as<std::string>;  // its text in a printed program
  { same.flop() } -> std::same_as<double>;       // FLOP of its products, two per multiply-add
};
#define VLA_CHECK_OP(Op) static_assert(LoweredOp<Op>, #Op " says operands(), text() and flop() in lower/ops");
VLA_LOWERED_OPS(VLA_CHECK_OP)
#undef VLA_CHECK_OP

#define VLA_OP_AND(Op) Op,
/// These operations, and those that a target adds.
template <class... More>
using AnyOp = std::variant<VLA_LOWERED_OPS(VLA_OP_AND) More...>;
#undef VLA_OP_AND

/// One operation of the program, made of one or several nodes.
struct FusedOp : Step {
  AnyOp<PackOp> op;
};

/// Fuses nodes into operations: norm into the product that follows; bias, activation, gate, factor and residual into
/// the product before; products of one x; gate and up; norm and rope into attention. A tapped node is computed on its
/// own.
std::vector<FusedOp> fuse(Lowering& l);
/// Lets operations write results straight to their slots if that is safe, else adds copies.
void store(Lowering& l, std::vector<FusedOp>& ops);

}  // namespace vla::lower
