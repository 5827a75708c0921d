// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <string>
#include <variant>
#include <vector>

#include "graph/device.h"
#include "lower/cpu_weights.h"

/// How a graph becomes a program for the CPU: a short list of passes over the structures below, each in a file of its
/// name (fuse, layout, blocks, schedule, place, emit).
namespace vla::lower {

/// An index into Lowering::values. Values of nodes come first, by Node::id.
using ValueId = int;
constexpr ValueId kNone = -1;

/// Where numbers lie: of a node's result, or of packed keys and values.
struct Value {
  enum class Home { arena, kept, slot, constant, parameter, thread };

  const Node* node = nullptr;  // none for packed keys and values, and for codes
  DType type = DType::f32;
  Shape shape = {1, 1, 1, 1};
  Shape stride = {1, 1, 1, 1};  // numbers from one index to the next
  ValueId base = kNone;         // whose memory this is: its own, or that of the value it is a view of
  std::int64_t offset = 0;      // numbers from the beginning of the base
  /// How bf16 lies that a product or attention has stored: strides are then those of rows that follow each other.
  kernels::RoundedLayout rounded = kernels::RoundedLayout::none;

  // Of a base alone.
  Home home = Home::arena;
  std::size_t size = 0;       // bytes
  std::byte* data = nullptr;  // known when memory is placed
};

/// What is done to rows of queries or keys on the way: nodes that were fused, or null.
struct Prepared {
  ValueId x;
  const Node *norm = nullptr, *rope = nullptr;
  ValueId weight = kNone, table = kNone;
};

/// activation(W x + b) * factor + residual, or up to three products of the same x, or gate and up of a gated MLP.
struct LinearOp {
  std::vector<const Node*> linears;
  ValueId x;
  const Node* norm = nullptr;  // x is what this node normalizes
  ValueId norm_weight = kNone, norm_bias = kNone;
  Activation activation = Activation::none;
  bool gated = false;
  ValueId factor = kNone, residual = kNone;
};
/// Rows of x as int8 codes with their scales, for products that take them (kernels/quantized.h).
struct QuantizeOp {
  ValueId x;
  const Node* norm = nullptr;  // x is what this node normalizes
  ValueId norm_weight = kNone, norm_bias = kNone;
  const kernels::LinearKernel* kernel;
};
struct PackOp {
  Prepared k;
  ValueId v;
  Features use;
};
struct AttentionOp {
  const Node* node;
  Prepared q;
  Features use;
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
/// Parts of the result from numbers that lie elsewhere: concat, pixel_shuffle, and views that must be contiguous.
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

struct FusedOp;
/// Two products, of which the second alone reads what the first makes, as in an MLP. A thread takes a block of rows
/// through both, so that the numbers between them stay in its cache: memory of the thread is their home.
struct BlockedOp {
  std::vector<FusedOp> products;
  std::int64_t n_block;
};

/// One operation of the program: nodes that were fused.
struct FusedOp {
  std::variant<LinearOp, QuantizeOp, PackOp, AttentionOp, RowOp, CopyOp, LookupOp, PatchesOp, BlockedOp> op;
  std::vector<ValueId> reads, writes;
  int order = 0;           // the id of the node whose result it gives
  bool invariant = false;  // the same from run to run
  int phase = 0;
};

struct Lowering {
  const Graph& graph;
  const LowerOptions& options;
  const CpuWeights& weights;
  Features use;
  std::int64_t min_rounded_keys;
  int n_thread;

  std::vector<Value> values;
  std::vector<FusedOp> ops;
  std::vector<std::vector<const Node*>> readers;  // of each node that is needed
  std::vector<bool> needed;                       // Graph::needed
  std::vector<bool> fused;                        // nodes that are part of an operation of another
  int n_prepare = 0, n_phase = 0;                 // phases of Program::prepare, and of both
  std::size_t arena_size = 0, kept_size = 0;

  const Node* node(ValueId id) const { return values[static_cast<std::size_t>(id)].node; }
  Value& value(ValueId id) { return values[static_cast<std::size_t>(id)]; }
  const Value& value(ValueId id) const { return values[static_cast<std::size_t>(id)]; }
  Value& base(ValueId id) { return value(value(id).base); }
  const Value& base(ValueId id) const { return value(value(id).base); }
};

/// Which stage an operation belongs to, by when its node was recorded.
std::size_t stage_of(const Lowering& l, const FusedOp& op);
/// What multiplies: all matrices of an operation have the same.
const kernels::LinearKernel& kernel_of(const Lowering& l, const LinearOp& op);
/// Strides of numbers that lie one after the other.
Shape contiguous_strides(const Shape& shape);
bool is_contiguous(const Value& value);
/// Whether all rows lie at the same distance: then that, else -1.
std::int64_t row_stride(const Value& value);

/// Finds what is needed, and makes a value of every node: memory of its own, or a view.
void start(Lowering& l);
/// Makes operations of nodes: norm into product; bias, activation, gate, factor and residual behind it; products of one
/// x; gate and up; norm and rope into attention. A tapped node is computed for itself.
void fuse(Lowering& l);
/// Chooses the dtype of values between products, makes codes of what ternary ones read, and copies what its reader
/// needs contiguous.
void choose_layouts(Lowering& l);
/// Joins two products to one operation on blocks of rows where what lies between them would not stay in a cache.
void choose_blocks(Lowering& l);
/// Puts operations that do not depend on each other into one phase, and what stays the same into Program::prepare.
void schedule(Lowering& l);
/// Gives every value its place: in its slot, in the memory that programs share, or in memory of the program.
void place(Lowering& l);

}  // namespace vla::lower
