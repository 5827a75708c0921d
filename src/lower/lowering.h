// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <string>
#include <vector>

#include "graph/device.h"
#include "graph/work.h"
#include "lower/target.h"

/// Turns a graph into a program for a machine. The files of lower/ itself are machine-independent: they ask a Target
/// for its abilities and know neither kernels nor addresses. A target's own passes run between `store` and `schedule`;
/// those of the CPU are in lower/cpu.
namespace vla::lower {

/// An index into Lowering::values. Values of nodes come first, by Node::id.
using ValueId = int;
constexpr ValueId kNone = -1;

/// The result of a node, or a value that a target adds, and its place in memory.
struct Value {
  /// arena: memory that all programs share. kept: memory of the program. slot: a slot's memory. thread: scratch memory
  /// of the thread that computes the value, for its readers in the same operation.
  enum class Placement { arena, kept, slot, constant, parameter, thread };

  const Node* node = nullptr;  // null for packed keys and values, and for values that a target adds
  DType type = DType::f32;
  Shape shape = {1, 1, 1, 1};
  Shape stride = {1, 1, 1, 1};  // elements from one index to the next
  ValueId base = kNone;         // the value that owns the memory: this one, or the one that this is a view of
  std::int64_t offset = 0;      // elements from the start of the base
  /// A layout of the target's own, with contiguous rows; 0: the strides describe the layout.
  int layout = 0;
  const char* form = "";  // the layout's name in a printed program

  // Valid for bases only.
  Placement placement = Placement::arena;
  std::size_t size = 0, begin = 0;  // bytes; begin: offset in the arena or in the program's own memory
  const Slot* slot = nullptr;
  int made = -1;  // the phase that computes it, or -1
};

/// An operand of an operation; a copy may replace it. kNone if the operation has no such operand.
struct Operand {
  ValueId& id;
  Needs needs;
};
using Operands = std::vector<Operand>;

/// The part of an operation that the passes after fusion use.
struct Step {
  std::vector<ValueId> reads = {}, writes = {};  // reads: the operands without kNone, in order
  std::vector<const Param*> matrices = {};       // matrices that it multiplies by
  int order = 0;                                 // the id of the node whose result it computes
  bool invariant = false;                        // its result is the same in every run
  int phase = 0;
};
struct Lowering {
  const Graph& graph;
  const LowerOptions& options;
  const Target& target;

  std::vector<Value> values = {};
  int n_prepare = 0, n_phase = 0;             // phases of Program::prepare; of prepare and run together
  std::size_t arena_size = 0, kept_size = 0;  // kept: results of prepare, and constants

  Value& value(ValueId id) { return values[static_cast<std::size_t>(id)]; }
  const Value& value(ValueId id) const { return values[static_cast<std::size_t>(id)]; }
  Value& base(ValueId id) { return value(value(id).base); }
  const Value& base(ValueId id) const { return value(value(id).base); }
  /// The group in which a matrix is streamed, or -1.
  int group_of(const Param& matrix) const { return target.groups[static_cast<std::size_t>(matrix.id)]; }
  /// The phase of a run after which a value is available.
  int there_in(ValueId id) const { return std::max(base(id).made, n_prepare); }
};

/// The index of the stage in which the operation's node was recorded.
std::size_t stage_of(const Lowering& l, const Step& step);
inline std::int64_t rows_of(const Shape& shape) { return count(shape) / shape[0]; }
/// Strides of contiguous elements.
Shape contiguous_strides(const Shape& shape);
/// The sizes or strides of x, in the order of the result's dimensions.
Shape permuted(const Shape& of_x, const op::Permute& permute);
/// The strides of x repeated along the dimensions in which it has one element.
Shape repeated_strides(const Value& x);
bool is_contiguous(const Shape& shape, const Shape& stride);
inline bool is_contiguous(const Value& value) { return is_contiguous(value.shape, value.stride); }
/// Copies the elements of a value into contiguous memory.
std::vector<float> contiguous(const float* data, const Shape& shape, const Shape& stride);
/// The distance between rows if it is the same for all, else -1.
std::int64_t row_stride(const Value& value);
/// The elements of a constant.
const void* constant_of(const Value& value);
/// The operand of a node, or kNone.
inline ValueId operand(const Node& node, std::size_t i) { return i < node.in.size() ? node.in[i].node()->id : kNone; }

/// Makes a value of every node: memory of its own, or a view.
void start(Lowering& l);
/// Adds a value that the target makes. `row`: elements from one row to the next.
ValueId add_value(Lowering& l, Shape shape, DType type, std::int64_t row);
/// Puts steps that do not depend on each other into one phase, and invariant steps into Program::prepare.
void schedule(Lowering& l, std::vector<Step*> steps);
/// Sets Value::begin: places of values in the arena or in the program's own memory.
void place(Lowering& l, const std::vector<Step*>& steps);
/// Splits phases until the groups of streamed matrices that each phase reads fit into the windows together. An
/// operation reads at most one group (`share_group`). Values keep their places: disjoint lifetimes stay disjoint.
void split(Lowering& l, const std::vector<Step*>& steps);
/// Whether one operation may read all of these matrices: the streamed ones must be in the same group.
bool share_group(const Lowering& l, const std::vector<const Param*>& matrices);
/// Schedules, places and splits a target's operations, and sorts them by phase.
template <class TargetOp>
void arrange(Lowering& l, std::vector<TargetOp>& ops) {
  std::vector<Step*> steps;
  for (TargetOp& op : ops) steps.push_back(&op);
  schedule(l, steps);
  place(l, steps);
  split(l, steps);
  std::ranges::stable_sort(ops, {}, [](const Step& step) { return std::pair(step.phase, step.order); });
}

/// The address of each base, from those of the arena and of the program's own memory. of_param: the address of a
/// parameter.
template <class Address, class OfParam>
std::vector<Address> addresses_of(const Lowering& l, Address arena, Address own, OfParam of_param) {
  const auto address = [&](const Value& value) -> Address {
    switch (value.placement) {
      case Value::Placement::arena:
        return arena + value.begin;
      case Value::Placement::kept:
      case Value::Placement::constant:
        return own + value.begin;
      case Value::Placement::slot:
        return reinterpret_cast<Address>(value.slot->place);
      case Value::Placement::parameter:
        return of_param(*value.node->as<op::Parameter>()->param);
      case Value::Placement::thread:
        break;  // scratch memory of each worker
    }
    return {};
  };
  std::vector<Address> all;
  for (const Value& value : l.values) all.push_back(&l.value(value.base) == &value ? address(value) : Address{});
  return all;
}

/// Prints an operation's line of Program::text: `what first operand -> results`.
std::string line_of(const Lowering& l, const Step& step, const std::string& kernel, const std::string& what,
                    const Work& work);
/// A node's name in such a line: its path, or its id.
std::string path_of(const Node& node);

}  // namespace vla::lower
