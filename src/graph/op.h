// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <memory>
#include <variant>
#include <vector>

#include "base/activation.h"
#include "bundle/params.h"
#include "graph/slot.h"

/// The operations of a graph: plain structs that say what is computed, not how. Operands are tensors in the order of
/// the comment; shapes follow ggml, fastest first. Graph::add checks them when an operation is recorded. Every pass
/// handles each operation by name and has no default, so a new operation does not compile until every pass knows it.
namespace vla::op {

/// Leaf: the contents of a slot when the graph runs.
struct Input {
  static constexpr const char* kName = "input";
  const Slot* slot;
};
/// Leaf: values that depend on shapes and configuration only (masks, rotary tables, ids).
struct Constant {
  static constexpr const char* kName = "constant";
  std::variant<std::vector<float>, std::vector<std::int32_t>> values;
};
/// Leaf: a declared vector, used as a tensor.
struct Parameter {
  static constexpr const char* kName = "parameter";
  const Param* param;
};

/// How a product is defined.
///
/// floats: sums of products of floats, rounded to the device's precision.
/// int8_rows: the weight is ternary, and each row of x is quantized to int8: a = max |x|, at least 1e-5,
/// s = (1 / a) * 127, and q = x * s rounded to the nearest, ties to even. Then W x is float(sum of products of codes) *
/// (scale of W / s). Every operation is rounded to float32 by itself; the sums are exact.
/// Source: BitVLA modeling_bitnet.py BitLinear, WeightQuant, ActQuant.
enum class Rule { floats, int8_rows };
/// x [d_in, n, ...] -> W x + b [d_out, n, ...]; bias may be null.
struct Linear {
  static constexpr const char* kName = "linear";
  const Param* weight;
  const Param* bias;
  Rule rule = Rule::floats;
};
/// ids [n] i32 -> rows of a declared table [d, n].
struct Embedding {
  static constexpr const char* kName = "embedding";
  const Param* table;
};
/// table [d, n_row], ids [n] i32 -> [d, n].
struct Gather {
  static constexpr const char* kName = "gather";
};

enum class NormKind { layer, rms };
/// Operands: x, then optional weight and bias [d]. layer: (x - mean) / sqrt(variance + eps) * weight + bias over the
/// first dimension; rms: x / sqrt(mean(x^2) + eps) * weight + bias.
struct Norm {
  static constexpr const char* kName = "norm";
  NormKind kind;
  float eps;
};
/// x [d_head, n_head, n, n_batch], table [d_head, n]: d_head/2 cosines per token, then d_head/2 sines. The pairs (x_i,
/// x_{i + d_head/2}) are rotated by the token's angles, the same in every head and batch.
struct Rope {
  static constexpr const char* kName = "rope";
};
/// q [d_head, n_head, n_query, n_batch], mask [n_key, n_query] if `has_mask`, then alternating segments of keys and
/// values, each [d_head, n_head_kv, n_key_i, n_batch], concatenated in order -> [d_head * n_head, n_query, n_batch].
/// softmax(q k / sqrt(d_head) + mask) v in float32. Every query must see a key.
struct Attention {
  static constexpr const char* kName = "attention";
  bool has_mask;
};
/// x -> the same shape.
struct Activate {
  static constexpr const char* kName = "activate";
  Activation activation;
};
/// a, b -> the shape of a. b is broadcast where it has 1 in a dimension.
struct Add {
  static constexpr const char* kName = "add";
};
struct Multiply {
  static constexpr const char* kName = "multiply";
};
/// x * factor.
struct Scale {
  static constexpr const char* kName = "scale";
  float factor;
};
/// Concatenates parts along dimension `dim`; their other dimensions are equal.
struct Concat {
  static constexpr const char* kName = "concat";
  int dim;
};
/// Indices first to first + count - 1 of dimension `dim`; `count` is in the result's shape.
struct Slice {
  static constexpr const char* kName = "slice";
  int dim;
  std::int64_t first;
};
/// x with 1 in some dimensions -> repeated to the result's shape.
struct Repeat {
  static constexpr const char* kName = "repeat";
};
/// The same elements in the same order.
struct Reshape {
  static constexpr const char* kName = "reshape";
};
/// Dimension i of the result is dimension order[i] of x.
struct Permute {
  static constexpr const char* kName = "permute";
  std::array<int, 4> order;
};
/// images [width, height, 3, n_view] -> pixels of non-overlapping patches, row by row: [3 * size^2, n_patch, n_view]. A
/// patch is ordered by channel, row, column.
struct Patches {
  static constexpr const char* kName = "patches";
  int size;
};
/// x [d, n, n_view], patches in rows of `n_column` -> each square of factor x factor patches becomes one token, with
/// the rows of the square in order: [d * factor^2, n / factor^2, n_view].
struct PixelShuffle {
  static constexpr const char* kName = "pixel_shuffle";
  int n_column, factor;
};
/// A window of size x size pixels that moves over an image in steps of `stride`. The image is padded by `padding`
/// pixels on each side. A side of n pixels has (n + 2 padding - size) / stride + 1 places.
struct Window {
  int size, stride, padding;
};
/// x [d, width, height, n_view] -> the pixels in the window at each of its places, row by row, with zeros outside of
/// the image (im2col): [d * size^2, n_column, n_row, n_view]. A product over it is a convolution.
struct Unfold {
  static constexpr const char* kName = "unfold";
  Window window;
};
/// x [d, width, height, n_view] -> the maximum of each feature in the window: [d, n_column, n_row, n_view]. Pixels
/// outside of the image are ignored; NaN if any value is NaN. The padding is at most half of the size.
struct MaxPool {
  static constexpr const char* kName = "max_pool";
  Window window;
};
/// x [d, width, height, n_view], weight [d * size^2], bias [d] -> each feature convolved with its own window of
/// weights, plus its bias: [d, n_column, n_row, n_view]. Weights are ordered by row, column, feature. Pixels outside of
/// the image are zeros.
struct Depthwise {
  static constexpr const char* kName = "depthwise";
  Window window;
};
/// q, k, v [d, n, n_view] -> the same shape. The features of each of `n_group` equal groups attend to each other, over
/// all tokens of a view: y_i = sum over j of softmax_j(q_i k_j / sqrt(n)) v_j, where q_i, k_j, v_j are rows of n
/// tokens.
struct ChannelAttention {
  static constexpr const char* kName = "channel_attention";
  static constexpr int kMaxGroup = 64;  // features in a group
  int n_group;
};
/// Stores x in a slot of its shape.
struct Write {
  static constexpr const char* kName = "write";
  Slot* slot;
};

}  // namespace vla::op

namespace vla {

using Op = std::variant<op::Input, op::Constant, op::Parameter, op::Linear, op::Embedding, op::Gather, op::Norm,
                        op::Rope, op::Attention, op::Activate, op::Add, op::Multiply, op::Scale, op::Concat, op::Slice,
                        op::Repeat, op::Reshape, op::Permute, op::Patches, op::PixelShuffle, op::Unfold, op::MaxPool,
                        op::Depthwise, op::ChannelAttention, op::Write>;

/// The operation's name in messages and printed graphs.
inline const char* op_name(const Op& op) {
  return std::visit([](const auto& known) { return known.kName; }, op);
}

}  // namespace vla
