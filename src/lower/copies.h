// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>

#include "lower/lowering.h"

namespace vla::lower {

/// Has operations read copies of what does not lie as their kernels take it. TargetLowering: a Lowering whose `ops` are
/// Steps that may hold a CopyOp.
template <class TargetLowering>
class Copies {
 protected:
  explicit Copies(TargetLowering& lowering) : l(lowering) {}

  /// A contiguous copy of a value, made just before the operation at hand, which reads that instead. A value with 1 in
  /// the first dimension may be copied `d` times.
  ValueId copied(ValueId id, std::int64_t d) {
    const auto copy = static_cast<ValueId>(l.values.size());
    Value& to = l.values.emplace_back(Value(l.value(id)));
    to.shape[0] = d;
    to.base = copy, to.offset = 0, to.stride = contiguous_strides(to.shape), to.placement = Value::Placement::arena;
    to.slot = nullptr, to.size = static_cast<std::size_t>(count(to.shape)) * 4;
    Shape from_stride = l.value(id).stride;
    if (l.value(id).shape[0] != d) from_stride[0] = 0;
    auto& op = l.ops.emplace_back();
    op.op = CopyOp{{{id, to.shape, from_stride, to.stride, 0}}};
    op.reads = {id}, op.writes = {copy}, op.order = step_->order;
    std::replace(step_->reads.begin(), step_->reads.end(), id, copy);
    return copy;
  }

  void require(ValueId& id, bool fits) {
    if (!fits) id = copied(id, l.value(id).shape[0]);
  }
  /// Elements of a row follow each other.
  void require_rows(ValueId& id) {
    if (id != kNone) require(id, l.value(id).shape[0] == 1 || l.value(id).stride[0] == 1);
  }
  void require_contiguous(ValueId& id) {
    if (id != kNone) require(id, is_contiguous(l.value(id)));
  }

  TargetLowering& l;
  Step* step_ = nullptr;  // the operation at hand
};

}  // namespace vla::lower
