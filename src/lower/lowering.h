// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <string>
#include <variant>
#include <vector>

#include "graph/device.h"
#include "lower/target.h"

/// How a graph becomes a program for a machine. What is here and in the files
/// beside it holds for every machine: it asks a Target what that can do, and
/// knows neither kernels nor addresses. A target's own passes come between
/// `store` and `schedule`; those of the CPU are in lower/cpu.
namespace vla::lower {

/// An index into Lowering::values. Values of nodes come first, by Node::id.
using ValueId = int;
constexpr ValueId kNone = -1;

/// The elements of a node's result, or of what a target makes on the way, and
/// where they lie.
struct Value {
  /// Memory that programs share, or of the program, or of a slot, ... thread:
  /// of whoever computes it, for its readers in the same operation.
  enum class Placement { arena, kept, slot, constant, parameter, thread };

  const Node* node = nullptr;  // none for packed keys and values, and for what targets add
  DType type = DType::f32;
  Shape shape = {1, 1, 1, 1};
  Shape stride = {1, 1, 1, 1};  // elements from one index to the next
  ValueId base = kNone;         // whose memory this is: its own, or that of the value
                                // it is a view of
  std::int64_t offset = 0;      // elements from the beginning of the base
  /// The target's own layout, in which strides are those of rows that follow
  /// each other. 0: strides say all.
  int layout = 0;

  // Of a base alone.
  Placement placement = Placement::arena;
  std::size_t size = 0, begin = 0;  // bytes, and those before it in the arena or
                                    // among what is kept
  const Slot* slot = nullptr;
  int made = -1;  // the phase that computes it; -1: none does
};

/// Rows of queries or keys, and the nodes that were fused to prepare them, or
/// null.
struct Prepared {
  ValueId x;
  const Node *norm = nullptr, *rope = nullptr;
  ValueId weight = kNone, table = kNone;
};

/// activation(W x + b) * factor + residual, or the ReLU of that, or up to three products of the same
/// x, or gate and up of a gated MLP.
struct LinearOp {
  std::vector<const Node*> linears;
  ValueId x;
  const Node* norm = nullptr;    // x is what this node normalizes
  const Node* unfold = nullptr;  // x is what this node moves a window over
  ValueId norm_weight = kNone, norm_bias = kNone;
  Activation activation = Activation::none;
  bool gated = false;
  bool ends_in_relu = false;
  ValueId factor = kNone, residual = kNone;
};
/// Keys and values as attention reads them: once for all attention over them.
struct PackOp {
  Prepared k;
  ValueId v;
  bool rounds;
};
struct AttentionOp {
  const Node* node;
  Prepared q;
  bool rounds;  // to what the device rounds products to; else it is float32
  ValueId mask = kNone;
  std::vector<ValueId> packed;
  std::vector<std::int64_t> n_key;
};
/// One row at a time.
struct RowOp {
  const Node* node;
  std::variant<op::Norm, op::Rope, op::Activate, op::Add, op::Multiply, op::Scale> what;
  ValueId x, w = kNone, b = kNone;
};
/// Parts of the result from elements that lie elsewhere: concat, pixel_shuffle,
/// and views that must be contiguous.
struct CopyOp {
  struct Part {
    ValueId from;
    Shape shape, from_stride, to_stride;
    std::int64_t to_offset, from_offset = 0;
  };
  std::vector<Part> parts;
};
/// embedding, gather
struct LookupOp {
  const Node* node;
  ValueId ids, table = kNone;
};
struct PatchesOp {
  const Node* node;
  ValueId images;
};
/// unfold, max_pool, depthwise
struct WindowOp {
  const Node* node;
  op::Window window;
  bool takes_largest;  // of the pixels that the window covers; else all of them, or their sum where there are weights
  ValueId x, weight = kNone, bias = kNone;
};
struct ChannelOp {
  const Node* node;
  ValueId q, k, v;
};

/// An operation as the passes behind fusion see it.
struct Step {
  std::vector<ValueId> reads, writes;
  int order = 0;           // the id of the node whose result it gives
  bool invariant = false;  // the same from run to run
  int phase = 0;
};
/// One operation of the program: nodes that were fused.
struct FusedOp : Step {
  std::variant<LinearOp, PackOp, AttentionOp, RowOp, CopyOp, LookupOp, PatchesOp, WindowOp, ChannelOp> op;
};

struct Lowering {
  const Graph& graph;
  const LowerOptions& options;
  const Target& target;

  std::vector<Value> values = {};
  std::vector<std::vector<const Node*>> readers = {};  // of each node that is needed
  std::vector<bool> needed = {};                       // Graph::needed
  std::vector<bool> fused = {};                        // nodes that are part of an operation of another
  int n_prepare = 0, n_phase = 0;                      // phases of Program::prepare, and of both
  std::size_t arena_size = 0, kept_size = 0;

  const Node* node(ValueId id) const { return values[static_cast<std::size_t>(id)].node; }
  Value& value(ValueId id) { return values[static_cast<std::size_t>(id)]; }
  const Value& value(ValueId id) const { return values[static_cast<std::size_t>(id)]; }
  Value& base(ValueId id) { return value(value(id).base); }
  const Value& base(ValueId id) const { return value(value(id).base); }
  /// The phase of a run behind which a value is there.
  int there_in(ValueId id) const { return std::max(base(id).made, n_prepare); }
};

/// Which stage an operation belongs to, by when its node was recorded.
std::size_t stage_of(const Lowering& l, const Step& step);
/// Strides of elements that lie one after the other.
Shape contiguous_strides(const Shape& shape);
bool is_contiguous(const Shape& shape, const Shape& stride);
inline bool is_contiguous(const Value& value) { return is_contiguous(value.shape, value.stride); }
/// The elements of a value one after the other.
std::vector<float> contiguous(const float* data, const Shape& shape, const Shape& stride);
/// Whether all rows lie at the same distance: then that, else -1.
std::int64_t row_stride(const Value& value);

/// Finds what is needed, and makes a value of every node: memory of its own, or
/// a view.
void start(Lowering& l);
/// Makes operations of nodes: norm into product; bias, activation, gate, factor
/// and residual behind it; products of one x; gate and up; norm and rope into
/// attention. A tapped node is computed for itself.
std::vector<FusedOp> fuse(Lowering& l);
/// Has results that slots get written there at once, or copied.
void store(Lowering& l, std::vector<FusedOp>& ops);

/// Puts steps that do not depend on each other into one phase, and what stays
/// the same into Program::prepare.
void schedule(Lowering& l, std::vector<Step*> steps);
/// Gives values their places in the memory that programs share, or among what
/// Program::prepare leaves: Value::begin.
void place(Lowering& l, const std::vector<Step*>& steps);

}  // namespace vla::lower
