// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <deque>
#include <functional>
#include <map>
#include <string>
#include <vector>

#include "graph/op.h"

namespace vla {

class Graph;
struct Node;

/// A value in a graph: a handle that modules and policies pass on. A sequence of tokens is [d_model, n_token].
class Tensor {
 public:
  Tensor() = default;
  explicit Tensor(Node* node) : node_(node) {}

  Node* node() const { return node_; }
  explicit operator bool() const { return node_ != nullptr; }
  const Shape& shape() const;
  std::int64_t dim(int i) const { return shape()[static_cast<std::size_t>(i)]; }
  bool operator==(const Tensor&) const = default;

 private:
  Node* node_ = nullptr;
};

/// One recorded operation and its result.
struct Node {
  int id;
  Op op;
  std::vector<Tensor> in;
  DType type;
  Shape shape;
  std::string path;     // of the module whose result this is, or empty
  bool tapped = false;  // its values are kept for `taps`

  template <class T>
  const T* as() const {
    return std::get_if<T>(&op);
  }
};

inline const Shape& Tensor::shape() const { return node_->shape; }

/// Says of a path whether its values are to be recorded. An empty function records nothing.
using TapFilter = std::function<bool(const std::string& path)>;
/// Says of a value with a path which slot is read in its place; null leaves it as it is.
using Injector = std::function<const Slot*(const std::string& path, Tensor value)>;

/// A list of operations in the order in which they are recorded. It knows no device: a lowering makes a Program of it.
class Graph {
 public:
  /// `slots` receives what is made on the way and outlives a run.
  explicit Graph(Slots& slots, TapFilter filter = {}, Injector injector = {});
  Graph(const Graph&) = delete;
  Graph& operator=(const Graph&) = delete;

  /// Records an operation on shapes that fit it. `shape` is that of the result where operands do not determine it.
  Tensor add(Op op, std::vector<Tensor> in, const Shape& shape = {});

  Tensor input(const Slot* slot);
  Tensor parameter(const Param* param);
  /// Values that depend on the shape alone: made once per graph for each `key`.
  Tensor constant(const std::string& key, const Shape& shape, const std::function<std::vector<float>()>& make);
  Tensor constant_ids(const std::string& key, const std::function<std::vector<std::int32_t>()>& make);
  /// Values without other readers.
  Tensor constant(std::vector<float> values, const Shape& shape);

  /// Gives `value` its path, under which it is recorded where the filter wants it. What is computed from it must be
  /// computed from the result, which may be another value: that of the injector.
  Tensor name(const std::string& path, Tensor value);
  void write(Tensor value, Slot* slot) { add(op::Write{slot}, {value}); }
  Slots& slots() const { return slots_; }
  /// Tells graphs apart, also those that are gone.
  std::uint64_t serial() const { return serial_; }

  /// Ends a stage: what was recorded up to here is computed before everything behind it, and a run notes the time.
  void end_stage(std::string name) { stages_.push_back({std::move(name), nodes_.size()}); }
  struct Stage {
    std::string name;
    std::size_t n_node;  // recorded before its end
  };

  const std::deque<Node>& nodes() const { return nodes_; }
  const std::vector<Stage>& stages() const { return stages_; }
  /// For each node, whether a write or a tap depends on it.
  std::vector<bool> needed() const;
  /// The first operation whose operands did not fit; empty where all did. A bug of ours, reported when it is lowered.
  const std::string& problem() const { return problem_; }

 private:
  Slots& slots_;
  TapFilter filter_;
  Injector injector_;
  std::uint64_t serial_;
  std::deque<Node> nodes_;  // a deque: tensors point to them
  std::vector<Stage> stages_;
  std::map<std::string, Tensor> constants_;
  std::map<const void*, Tensor> leaves_;
  std::string problem_;
};

}  // namespace vla
