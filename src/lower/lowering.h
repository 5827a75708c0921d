// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <string>
#include <vector>

#include "graph/device.h"
#include "graph/work.h"
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
  const char* form = "";  // its name in a printed program

  // Of a base alone.
  Placement placement = Placement::arena;
  std::size_t size = 0, begin = 0;  // bytes, and those before it in the arena or
                                    // in the program's own memory
  const Slot* slot = nullptr;
  int made = -1;  // the phase that computes it; -1: none does
};

/// An operand of an operation, which may become a copy; kNone where there is none.
struct Operand {
  ValueId& id;
  Needs needs;
};
using Operands = std::vector<Operand>;

/// An operation as the passes behind fusion see it.
struct Step {
  std::vector<ValueId> reads, writes;  // reads: the operands that there are, in their order
  int order = 0;                       // the id of the node whose result it gives
  bool invariant = false;              // the same from run to run
  int phase = 0;
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
  std::size_t arena_size = 0, kept_size = 0;           // kept: what prepare leaves, and constants

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
/// The elements of a constant.
const void* constant_of(const Value& value);
/// The operand of a node, or kNone.
inline ValueId operand(const Node& node, std::size_t i) { return i < node.in.size() ? node.in[i].node()->id : kNone; }

/// Finds what is needed, and makes a value of every node: memory of its own, or
/// a view.
void start(Lowering& l);
/// Puts steps that do not depend on each other into one phase, and what stays
/// the same into Program::prepare.
void schedule(Lowering& l, std::vector<Step*> steps);
/// Gives values their places in the memory that programs share, or in the
/// program's own: Value::begin.
void place(Lowering& l, const std::vector<Step*>& steps);
/// Both, for a target's operations, which then stand in the order of their phases.
template <class TargetOp>
void arrange(Lowering& l, std::vector<TargetOp>& ops) {
  std::vector<Step*> steps;
  for (TargetOp& op : ops) steps.push_back(&op);
  schedule(l, steps);
  place(l, steps);
  std::stable_sort(ops.begin(), ops.end(), [](const Step& a, const Step& b) {
    return std::pair(a.phase, a.order) < std::pair(b.phase, b.order);
  });
}

/// An operation's line of Program::text: `what first operand -> results`.
std::string line_of(const Lowering& l, const Step& step, const std::string& kernel, const std::string& what,
                    const Work& work);
/// A node as such a line names it.
std::string path_of(const Node& node);

}  // namespace vla::lower
