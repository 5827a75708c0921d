// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>
#include <variant>
#include <vector>

#include "base/activation.h"
#include "bundle/params.h"
#include "graph/slot.h"

/// What a graph is made of: plain structs that say what is computed and nothing about how. Operands are tensors, in the
/// order of the comment; shapes follow ggml, fastest first. Graph::add checks them when an operation is recorded.
namespace vla::op {

/// Leaf: what a slot holds when the graph runs.
struct Input {
  const Slot* slot;
};
/// Leaf: numbers that depend on shapes and configuration alone (masks, rotary tables, ids).
struct Constant {
  std::variant<std::vector<float>, std::vector<std::int32_t>> values;
};
/// Leaf: a declared vector as a tensor of its own.
struct Parameter {
  const Param* param;
};

/// x [d_in, n, ...] -> W x + b [d_out, n, ...]; bias may be null.
///
/// With `scale` [1] the weight is ternary, -scale, 0 or scale, and x becomes int8 first: of each row a = max |x|, at
/// least 1e-5, s = (1 / a) * 127, and q = x * s rounded to the nearest, ties to even. Then W x is float(sum of products
/// of codes) * (scale / s). Every operation is rounded to float32 by itself; the sums are exact.
/// Source: BitVLA modeling_bitnet.py BitLinear, WeightQuant, ActQuant.
struct Linear {
  const Param* weight;
  const Param* bias;
  const Param* scale = nullptr;
};
/// ids [n] i32 -> rows of a declared table [d, n].
struct Embedding {
  const Param* table;
};
/// table [d, n_row], ids [n] i32 -> [d, n].
struct Gather {};

enum class NormKind { layer, rms };
/// x, then weight and bias [d] where there are any. layer: (x - mean) / sqrt(variance + eps) * weight + bias over the
/// first dimension; rms: x / sqrt(mean(x^2) + eps) * weight + bias.
struct Norm {
  NormKind kind;
  float eps;
};
/// x [d_head, n_head, n, n_batch], table [d_head, n]: per token d_head/2 cosines, then sines. The pairs
/// (x_i, x_{i + d_head/2}) turn by the token's angles, in every head and batch alike.
struct Rope {};
/// q [d_head, n_head, n_query, n_batch], mask [n_key, n_query] if `has_mask`, then segments of keys and values in turn,
/// each [d_head, n_head_kv, n_key_i, n_batch], which stand one after the other -> [d_head * n_head, n_query, n_batch].
/// softmax(q k / sqrt(d_head) + mask) v in float32. Every query must see a key.
struct Attention {
  bool has_mask;
};
/// x -> the same shape.
struct Activate {
  Activation activation;
};
/// a, b -> the shape of a. Where b has 1 in a dimension it counts for all of a's.
struct Add {};
struct Multiply {};
/// x * factor.
struct Scale {
  float factor;
};
/// Parts that differ in dimension `dim` only, one after the other.
struct Concat {
  int dim;
};
/// Indices first to first + count - 1 of dimension `dim`; `count` is in the result's shape.
struct Slice {
  int dim;
  std::int64_t first;
};
/// x with 1 in a dimension -> as often as the result's shape says.
struct Repeat {};
/// The same numbers in the same order.
struct Reshape {};
/// images [width, height, 3, n_view] -> pixels of non-overlapping patches, row by row: [3 * size^2, n_patch, n_view],
/// of a patch channel, row, column.
struct Patches {
  int size;
};
/// x [d, n, n_view], patches in rows of `n_column` -> squares of factor x factor patches as one token, of a square its
/// rows one after the other: [d * factor^2, n / factor^2, n_view].
struct PixelShuffle {
  int n_column, factor;
};
/// Stores x in a slot of its shape.
struct Write {
  Slot* slot;
};

}  // namespace vla::op

namespace vla {

using Op = std::variant<op::Input, op::Constant, op::Parameter, op::Linear, op::Embedding, op::Gather, op::Norm,
                        op::Rope, op::Attention, op::Activate, op::Add, op::Multiply, op::Scale, op::Concat, op::Slice,
                        op::Repeat, op::Reshape, op::Patches, op::PixelShuffle, op::Write>;

/// The operation's word, for messages and printed graphs.
const char* op_name(const Op& op);

}  // namespace vla
