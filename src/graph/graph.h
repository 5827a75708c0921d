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

/// A handle to a value in a graph. A sequence of tokens is [d_model, n_token].
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
  std::string path;     // path of the module that returned it, or empty
  bool tapped = false;  // whether `taps` keeps its values

  template <class T>
  const T* as() const {
    return std::get_if<T>(&op);
  }
};

inline const Shape& Tensor::shape() const { return node_->shape; }

/// Decides by a value's path whether to record the value. An empty function records nothing.
using TapFilter = std::function<bool(const std::string& path)>;
/// Returns the slot that replaces the value of a path, or null to keep the value.
using Injector = std::function<const Slot*(const std::string& path, Tensor value)>;

/// The recorded operations in order. A graph is independent of the device; a lowering compiles it to a Program.
class Graph {
 public:
  /// `slots` receives values that outlive a run.
  explicit Graph(Slots& slots, TapFilter filter = {}, Injector injector = {});
  Graph(const Graph&) = delete;
  Graph& operator=(const Graph&) = delete;

  /// Records an operation whose operands fit. `shape` is the result's shape where the operands do not determine it.
  Tensor add(Op op, std::vector<Tensor> in, const Shape& shape = {});

  Tensor input(const Slot* slot);
  Tensor parameter(const Param* param);
  /// Values that depend only on shapes. `make` is called once per graph for each `key`.
  Tensor constant(const std::string& key, const Shape& shape, const std::function<std::vector<float>()>& make);
  Tensor constant_ids(const std::string& key, const std::function<std::vector<std::int32_t>()>& make);
  /// The same without a key, for values that one operation reads.
  Tensor constant(std::vector<float> values, const Shape& shape);

  /// Gives `value` its path and records it if the filter says so. Later operations must use the returned tensor, which
  /// is the injector's if it replaces the value.
  Tensor name(const std::string& path, Tensor value);
  void write(Tensor value, Slot* slot) { add(op::Write{slot}, {value}); }
  Slots& slots() const { return slots_; }
  /// A number unique to this graph in the process.
  std::uint64_t serial() const { return serial_; }

  /// Ends a stage: a run computes everything recorded so far before the rest and records the time.
  void end_stage(std::string name) { stages_.push_back({std::move(name), nodes_.size()}); }
  struct Stage {
    std::string name;
    std::size_t n_node;  // nodes recorded before the stage's end
  };

  const std::deque<Node>& nodes() const { return nodes_; }
  const std::vector<Stage>& stages() const { return stages_; }
  /// For each node, whether a stored or tapped value depends on it.
  std::vector<bool> needed() const;
  /// The first operation whose operands do not fit, or empty. It is a bug of ours and is reported when the graph is
  /// lowered.
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
