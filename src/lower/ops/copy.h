// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lower/lowering.h"

namespace vla::lower {

/// Copies parts of the result from other values: concat, pixel_shuffle, patches, and views that must be contiguous.
struct CopyOp {
  using Extents = std::array<std::int64_t, 6>;  // sizes or strides, fastest first
  struct Part {
    /// Copies all elements of a shape.
    Part(ValueId id, const Shape& size, const Shape& step, const Shape& to_step) : from(id) {
      shape.fill(1);
      std::copy(size.begin(), size.end(), shape.begin());
      std::copy(step.begin(), step.end(), from_stride.begin());
      std::copy(to_step.begin(), to_step.end(), to_stride.begin());
    }

    ValueId from;
    Extents shape, from_stride = {}, to_stride = {};
    std::int64_t from_offset = 0, to_offset = 0;
  };

  const Node* node = nullptr;  // the node that it computes; null for a copy that a pass adds
  std::vector<Part> parts;

  Operands operands() {
    Operands all;
    for (Part& part : parts) all.push_back({part.from, Needs::anything});
    return all;
  }
  std::string text() const {
    if (node != nullptr && node->as<op::Patches>() != nullptr) return "patches";
    return "copy " + std::to_string(parts.size()) + (parts.size() == 1 ? " part" : " parts");
  }
  double flop() const { return 0; }
};

CopyOp lowered(const Lowering& l, const Node& node, const op::Concat& concat);
CopyOp lowered(const Lowering& l, const Node& node, const op::PixelShuffle& shuffle);
CopyOp lowered(const Lowering& l, const Node& node, const op::Patches& patches);
// For nodes that would be views, but must be copies.
CopyOp lowered(const Lowering& l, const Node& node, const op::Slice& slice);
CopyOp lowered(const Lowering& l, const Node& node, const op::Repeat& repeat);
CopyOp lowered(const Lowering& l, const Node& node, const op::Reshape& reshape);
CopyOp lowered(const Lowering& l, const Node& node, const op::Permute& permute);

}  // namespace vla::lower
