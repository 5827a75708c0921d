// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/ops/copy.h"

namespace vla::lower {
namespace {

/// Copies the whole first operand into contiguous elements.
CopyOp::Part whole_operand(const Lowering& l, const Node& node) {
  const Value& x = l.value(operand(node, 0));
  return {operand(node, 0), x.shape, x.stride, contiguous_strides(x.shape)};
}

}  // namespace

CopyOp lowered(const Lowering& l, const Node& node, const op::Concat& concat) {
  CopyOp op = {&node, {}};
  const auto dim = static_cast<std::size_t>(concat.dim);
  const Shape to = contiguous_strides(node.shape);
  std::int64_t offset = 0;
  for (Tensor part : node.in) {
    const Value& from = l.value(part.node()->id);
    op.parts.emplace_back(part.node()->id, from.shape, from.stride, to).to_offset = offset;
    offset += from.shape[dim] * to[dim];
  }
  return op;
}

/// Element (factor R + r, factor C + c) goes to part (r, c) of token (R, C): one copy per part.
CopyOp lowered(const Lowering& l, const Node& node, const op::PixelShuffle& shuffle) {
  const auto [n_column, factor] = shuffle;
  const Value& x = l.value(operand(node, 0));
  const std::int64_t d = x.shape[0], row = x.stride[1], n_row = x.shape[1] / n_column;
  const Shape shape = {d, n_column / factor, n_row / factor, x.shape[2]};
  const Shape from = {x.stride[0], factor * row, factor * n_column * row, x.stride[2]};
  const Shape to = {1, node.shape[0], node.shape[0] * (n_column / factor), node.shape[0] * node.shape[1]};
  CopyOp op = {&node, {}};
  for (int r = 0; r < factor; ++r)
    for (int c = 0; c < factor; ++c) {
      CopyOp::Part& part = op.parts.emplace_back(operand(node, 0), shape, from, to);
      part.from_offset = (r * n_column + c) * row;  // the part starts at element (r, c)
      part.to_offset = (r * factor + c) * d;
    }
  return op;
}

/// Dimensions, fastest first: pixels of a patch's row, its rows, channels, then patches by column, row and view.
CopyOp lowered(const Lowering& l, const Node& node, const op::Patches& patches) {
  const Value& x = l.value(operand(node, 0));
  const std::int64_t size = patches.size, columns = x.shape[0] / size, rows = x.shape[1] / size;
  const Shape& from = x.stride;
  const std::int64_t d = node.shape[0];
  CopyOp::Part part = whole_operand(l, node);
  part.shape = {size, size, 3, columns, rows, x.shape[3]};
  part.from_stride = {from[0], from[1], from[2], size * from[0], size * from[1], from[3]};
  part.to_stride = {1, size, size * size, d, d * columns, d * columns * rows};
  return {&node, {part}};
}

CopyOp lowered(const Lowering& l, const Node& node, const op::Slice& slice) {
  const Value& x = l.value(operand(node, 0));
  CopyOp::Part part(operand(node, 0), node.shape, x.stride, contiguous_strides(node.shape));
  part.from_offset = slice.first * x.stride[static_cast<std::size_t>(slice.dim)];
  return {&node, {part}};
}

CopyOp lowered(const Lowering& l, const Node& node, const op::Repeat&) {
  const Shape from = repeated_strides(l.value(operand(node, 0)));
  return {&node, {{operand(node, 0), node.shape, from, contiguous_strides(node.shape)}}};
}

CopyOp lowered(const Lowering& l, const Node& node, const op::Permute& permute) {
  const Shape from = permuted(l.value(operand(node, 0)).stride, permute);
  return {&node, {{operand(node, 0), node.shape, from, contiguous_strides(node.shape)}}};
}

CopyOp lowered(const Lowering& l, const Node& node, const op::Reshape&) { return {&node, {whole_operand(l, node)}}; }

}  // namespace vla::lower
