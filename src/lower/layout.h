// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <tuple>

#include "lower/ops.h"

namespace vla::lower {

/// Makes operands meet their operations' needs. A target derives its own class for products, attention and packing.
template <class TargetLowering>
class Layouts {
 protected:
  explicit Layouts(TargetLowering& lowering) : l(lowering) {}

  /// Copies the operands that do not meet their needs, and records all as the step's reads.
  void meet(Step& step, const Operands& operands) {
    step.reads.clear();
    for (const auto& [id, needs] : operands) {
      if (id == kNone) continue;
      if (fit_of(l.value(id)) < needs) id = copied(id, step.order);
      step.reads.push_back(id);
    }
  }
  /// Makes a product read x, or its norm, in another type. The first such product adds the conversion; later ones share
  /// it.
  void round(const Step& step, LinearOp& op, DType type, std::int64_t row, const char* verb) {
    const auto [known, is_new] = rounded_.try_emplace({op.x, op.norm, type}, kNone);
    if (is_new) {
      RoundOp made = {.product = op.linears[0],
                      .x = op.x,
                      .norm = op.norm,
                      .weight = op.norm_weight,
                      .bias = op.norm_bias,
                      .verb = verb};
      Step before = {.order = step.order};
      meet(before, made.operands());
      known->second = add_value(l, l.value(made.x).shape, type, row);
      before.writes = {known->second};
      l.ops.push_back({std::move(before), std::move(made)});
    }
    op.x = known->second, op.norm = nullptr, op.norm_weight = op.norm_bias = kNone;
  }

  TargetLowering& l;

 private:
  /// Returns the strictest need that a value meets.
  static Needs fit_of(const Value& value) {
    if (is_contiguous(value)) return Needs::contiguous;
    if (row_stride(value) >= 0) return Needs::even_rows;
    return value.shape[0] == 1 || value.stride[0] == 1 ? Needs::unit_rows : Needs::anything;
  }
  /// Adds a contiguous copy of a value.
  ValueId copied(ValueId id, int order) {
    const Value from = l.value(id);
    const ValueId copy = add_value(l, from.shape, from.type, from.shape[0]);
    Value& to = l.value(copy);
    to.node = from.node;
    l.ops.push_back({{.reads = {id}, .writes = {copy}, .order = order},
                     CopyOp{nullptr, {{id, from.shape, from.stride, to.stride}}}});
    return copy;
  }

  std::map<std::tuple<ValueId, const Node*, DType>, ValueId> rounded_;  // converted x, or its norm
};

}  // namespace vla::lower
