// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>

#include "lower/ops.h"

namespace vla::lower {
namespace {

/// Whether `result` may be written straight to the slot of `write`. True if no later operation reads the slot; a
/// row-wise operation may read it itself, since it reads each element before it writes it.
bool may_write(const Lowering& l, const std::vector<FusedOp>& ops, const Node& write, ValueId result) {
  const Slot* slot = l.value(write.id).slot;
  const auto writer = std::ranges::find_if(
      ops, [&](const FusedOp& op) { return std::ranges::find(op.writes, result) != op.writes.end(); });
  if (writer == ops.end()) return false;
  for (const FusedOp& op : ops)
    for (const ValueId id : op.reads) {
      if (l.base(id).placement != Value::Placement::slot || l.base(id).slot != slot) continue;
      if (op.order > writer->order) return false;
      if (op.order < writer->order) continue;
      const Value& value = l.value(id);
      const bool in_place = std::holds_alternative<RowOp>(op.op) && value.shape == l.value(result).shape &&
                            value.offset == 0 && is_contiguous(value);
      if (!in_place) return false;
    }
  return true;
}

/// Writes a value straight to its slot if that is safe, else adds a copy.
void store(Lowering& l, std::vector<FusedOp>& ops, const Node& write) {
  const ValueId from = write.in[0].node()->id;
  Value& value = l.value(from);
  Value& base = l.base(from);
  const bool is_whole = is_contiguous(value) && value.offset == 0 && count(value.shape) == count(base.shape);
  if (is_whole && base.placement == Value::Placement::arena && may_write(l, ops, write, value.base)) {
    base.placement = Value::Placement::slot, base.slot = l.value(write.id).slot;
    return;
  }
  FusedOp& op = ops.emplace_back();
  op.op = CopyOp{nullptr, {{from, value.shape, value.stride, contiguous_strides(value.shape)}}};
  op.reads = {from}, op.writes = {write.id}, op.order = write.id;
}

}  // namespace

void store(Lowering& l, std::vector<FusedOp>& ops) {
  for (const Node& node : l.graph.nodes())
    if (node.as<op::Write>() != nullptr) store(l, ops, node);
}

}  // namespace vla::lower
