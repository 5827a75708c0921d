// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/layout.h"

namespace vla::lower {

namespace {

/// Returns the strictest need that a value meets.
Needs fit_of(const Value& value) {
  if (is_contiguous(value)) return Needs::contiguous;
  if (row_stride(value) >= 0) return Needs::even_rows;
  return value.shape[0] == 1 || value.stride[0] == 1 ? Needs::unit_rows : Needs::anything;
}

}  // namespace

void Layouts::meet(Step& step, const Operands& operands) {
  step.reads.clear();
  for (const auto& [id, needs] : operands) {
    if (id == kNone) continue;
    if (fit_of(lowering_.value(id)) < needs) id = copied(id, step.order);
    step.reads.push_back(id);
  }
}

/// Adds a contiguous copy of a value.
ValueId Layouts::copied(ValueId id, int order) {
  const Value from = lowering_.value(id);
  const ValueId copy = add_value(from.shape, from.type, from.shape[0]);
  Value& to = lowering_.value(copy);
  to.node = from.node;
  Step step = {.reads = {id}, .writes = {copy}, .order = order};
  add(std::move(step), CopyOp{nullptr, {{id, from.shape, from.stride, to.stride}}});
  return copy;
}

ValueId Layouts::add_value(Shape shape, DType type, std::int64_t row) {
  const auto id = static_cast<ValueId>(lowering_.values.size());
  const Shape padded = {row, shape[1], shape[2], shape[3]};
  Value& value = lowering_.values.emplace_back();
  value.type = type, value.shape = shape, value.stride = contiguous_strides(padded), value.base = id;
  value.size = dtype_size(type, count(padded));
  return id;
}

void Layouts::round(const Step& step, LinearOp& op, DType type, std::int64_t row, const char* verb) {
  const auto [known, is_new] = rounded_.try_emplace({op.x, op.norm, type}, kNone);
  if (is_new) {
    RoundOp made = {.product = op.linears[0],
                    .x = op.x,
                    .norm = op.norm,
                    .weight = op.norm_weight,
                    .bias = op.norm_bias,
                    .verb = verb};
    Step before = {.reads = {}, .writes = {}, .order = step.order};
    meet(before, made.operands());
    known->second = add_value(lowering_.value(made.x).shape, type, row);
    before.writes = {known->second};
    add(std::move(before), std::move(made));
  }
  op.x = known->second, op.norm = nullptr, op.norm_weight = op.norm_bias = kNone;
}

}  // namespace vla::lower
