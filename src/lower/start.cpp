// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <optional>

#include "lower/lowering.h"

namespace vla::lower {

Shape contiguous_strides(const Shape& shape) {
  return {1, shape[0], shape[0] * shape[1], shape[0] * shape[1] * shape[2]};
}

Shape permuted(const Shape& of_x, const op::Permute& permute) {
  Shape result;
  for (std::size_t i = 0; i < 4; ++i) result[i] = of_x[static_cast<std::size_t>(permute.order[i])];
  return result;
}

Shape repeated_strides(const Value& x) {
  Shape stride = x.stride;
  for (std::size_t i = 0; i < 4; ++i)
    if (x.shape[i] == 1) stride[i] = 0;
  return stride;
}

bool is_contiguous(const Shape& shape, const Shape& stride) {
  const Shape packed = contiguous_strides(shape);
  for (std::size_t i = 0; i < 4; ++i)
    if (shape[i] != 1 && stride[i] != packed[i]) return false;
  return true;
}

std::vector<float> contiguous(const float* data, const Shape& shape, const Shape& stride) {
  std::vector<float> values;
  values.reserve(static_cast<std::size_t>(count(shape)));
  for (std::int64_t a = 0; a < shape[3]; ++a)
    for (std::int64_t b = 0; b < shape[2]; ++b)
      for (std::int64_t c = 0; c < shape[1]; ++c)
        for (std::int64_t d = 0; d < shape[0]; ++d)
          values.push_back(data[a * stride[3] + b * stride[2] + c * stride[1] + d * stride[0]]);
  return values;
}

std::int64_t row_stride(const Value& value) {
  if (value.shape[0] != 1 && value.stride[0] != 1) return -1;
  std::int64_t row = value.shape[0], n = 0;  // rows so far
  for (std::size_t i = 1; i < 4; ++i) {
    if (value.shape[i] == 1) continue;
    if (n == 0)
      row = value.stride[i], n = value.shape[i];
    else if (value.stride[i] == row * n)
      n *= value.shape[i];
    else
      return -1;
  }
  return row;
}

const void* constant_of(const Value& value) {
  return std::visit([](const auto& elements) -> const void* { return elements.data(); },
                    value.node->as<op::Constant>()->values);
}

namespace {

/// Returns the strides of a reshaped view if no copy is needed: each new dimension must be cut from old dimensions that
/// are contiguous with each other.
std::optional<Shape> reshape_strides(const Value& value, const Shape& to) {
  std::vector<std::int64_t> sizes, strides;  // the old shape, with contiguous dimensions joined
  for (std::size_t i = 0; i < 4; ++i) {
    if (value.shape[i] == 1) continue;
    if (!sizes.empty() && value.stride[i] == strides.back() * sizes.back())
      sizes.back() *= value.shape[i];
    else
      sizes.push_back(value.shape[i]), strides.push_back(value.stride[i]);
  }
  Shape result = contiguous_strides(to);
  std::size_t at = 0;
  std::int64_t taken = 1;  // elements used of the current old dimension
  for (std::size_t i = 0; i < 4; ++i) {
    if (to[i] == 1) continue;
    if (at == sizes.size() || sizes[at] % (taken * to[i]) != 0) return {};
    result[i] = strides[at] * taken;
    taken *= to[i];
    if (taken == sizes[at]) ++at, taken = 1;
  }
  return result;
}

/// Makes a view if the node computes nothing, else a value of its own.
struct MakeValue {
  const Lowering& l;
  const Node& node;

  Value operator()(const op::Input& op) const { return own(Value::Placement::slot, op.slot); }
  Value operator()(const op::Write& op) const { return own(Value::Placement::slot, op.slot); }
  Value operator()(const op::Constant&) const { return own(Value::Placement::constant); }
  Value operator()(const op::Parameter&) const { return own(Value::Placement::parameter); }

  Value operator()(const op::Slice& op) const {
    return view(x().stride, op.first * x().stride[static_cast<std::size_t>(op.dim)]);
  }
  Value operator()(const op::Repeat&) const { return view(repeated_strides(x())); }
  Value operator()(const op::Permute& op) const { return view(permuted(x().stride, op)); }
  Value operator()(const op::Reshape&) const {
    const auto stride = reshape_strides(x(), node.shape);
    return stride ? view(*stride) : own();
  }

  /// All other nodes compute something.
  template <class Computes>
  Value operator()(const Computes&) const {
    return own();
  }

 private:
  const Value& x() const { return l.value(node.in[0].node()->id); }
  Value own(Value::Placement placement = Value::Placement::arena, const Slot* slot = nullptr) const {
    return {.node = &node,
            .type = node.type,
            .shape = node.shape,
            .stride = contiguous_strides(node.shape),
            .base = node.id,
            .placement = placement,
            .size = dtype_size(node.type, count(node.shape)),
            .slot = slot};
  }
  /// A view of x, or a copy if it is tapped and x's slot may be overwritten later in the run.
  Value view(const Shape& stride, std::int64_t offset = 0) const {
    Value value = own();
    if (node.tapped && l.base(x().base).placement == Value::Placement::slot) return value;
    value.base = x().base, value.stride = stride, value.offset = x().offset + offset, value.size = 0;
    return value;
  }
};

}  // namespace

void start(Lowering& l) {
  for (const Node& node : l.graph.nodes()) l.values.push_back(std::visit(MakeValue{l, node}, node.op));
}

ValueId add_value(Lowering& l, Shape shape, DType type, std::int64_t row) {
  const auto id = static_cast<ValueId>(l.values.size());
  const Shape padded = {row, shape[1], shape[2], shape[3]};
  Value& value = l.values.emplace_back();
  value.type = type, value.shape = shape, value.stride = contiguous_strides(padded), value.base = id;
  value.size = dtype_size(type, count(padded));
  return id;
}

}  // namespace vla::lower
