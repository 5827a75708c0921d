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

/// The operations that every target runs: a file of lower/ops says what each is and needs, one of lower/cpu/ops and
/// one of lower/cuda/ops how a target runs it.
#define VLA_LOWERED_OPS(OP) \
  OP(LinearOp) OP(RoundOp) OP(AttentionOp) OP(RowOp) OP(CopyOp) OP(LookupOp) OP(WindowOp) OP(ChannelOp)

namespace vla::lower {

template <class Op>
concept LoweredOp = requires(Op op, const Op& same) {
  { op.operands() } -> std::same_as<Operands>;   // which values it reads, and how they must lie
  { same.text() } -> std::same_as<std::string>;  // what it computes, as a printed program says it
  { same.flop() } -> std::same_as<double>;       // operations of its products, two for each multiply-add
};
#define VLA_CHECK_OP(Op) static_assert(LoweredOp<Op>, #Op " says operands(), text() and flop() in lower/ops");
VLA_LOWERED_OPS(VLA_CHECK_OP)
#undef VLA_CHECK_OP

template <class, class... Ops>
struct OpList {
  template <class... More>
  using With = std::variant<Ops..., More...>;
};
#define VLA_NEXT_OP(Op) , Op
/// Those, and operations that a target has beside them.
template <class... More>
using AnyOp = typename OpList<void VLA_LOWERED_OPS(VLA_NEXT_OP)>::template With<More...>;
#undef VLA_NEXT_OP

/// One operation of the program: nodes that were fused.
struct FusedOp : Step {
  AnyOp<PackOp> op;
};

/// Makes operations of nodes: norm into product; bias, activation, gate, factor and residual behind it; products of
/// one x; gate and up; norm and rope into attention. A tapped node is computed for itself.
std::vector<FusedOp> fuse(Lowering& l);
/// Has results that slots get written there at once, or copied.
void store(Lowering& l, std::vector<FusedOp>& ops);

}  // namespace vla::lower
