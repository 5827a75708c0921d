// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <chrono>
#include <deque>
#include <functional>
#include <map>
#include <string>
#include <unordered_map>
#include <utility>
#include <vector>

#include "backend/device.h"
#include "backend/store.h"
#include "backend/weights.h"
#include "backend/work.h"

namespace vla {

/// Says of a path whether its values are to be kept. An empty function keeps nothing, and the graph is the production
/// graph.
using TapFilter = std::function<bool(const std::string& path)>;

/// Working memory that all graphs share, since only one of them runs at a time.
class ComputeMemory {
 public:
  explicit ComputeMemory(const Device& device)
      : allocator_(ggml_gallocr_new(ggml_backend_get_default_buffer_type(device.backend()))) {}
  ggml_gallocr_t allocator() const { return allocator_.get(); }
  /// Makes the memory large enough for `graph`. Growing invalidates every graph that was allocated before.
  Status reserve(ggml_cgraph* graph);
  std::size_t size() const { return ggml_gallocr_get_buffer_size(allocator_.get(), 0); }

 private:
  ggml_gallocr_ptr allocator_;
};

/// A named part of a graph that ends where `mark` is computed; `done` is when that was in the last run.
struct Stage {
  std::string name;
  Tensor mark;
  std::chrono::steady_clock::time_point done;
};

/// One graph: built once, given memory once, then run as often as wanted. `nn` adds operations through `context()`.
class Graph {
 public:
  /// `store` holds what outlives a run: constants that modules ask for, and whatever the owner adds.
  Graph(const Weights& weights, Store& store, TapFilter keep);

  ggml_context* context() const { return context_.get(); }
  Tensor weight(const Param* param) const { return weights_[param]; }
  Store& store() { return store_; }
  /// How a matrix lies in memory, which says what kernel multiplies by it; null for ggml's product.
  const MatrixFormat* format(const Param* matrix) const { return weights_.format(matrix); }
  /// Memory that kernels work in, which belongs to the device.
  Scratch& scratch() const { return weights_.scratch(); }
  /// Which kernels the operations are to be built from.
  Isa isa() const { return weights_.isa(); }

  /// Values that depend on the shape alone (masks, rotary tables): made once per graph for each `key`.
  Tensor constant(const std::string& key, const std::function<Tensor(Store&)>& make);

  /// Gives `value` its path; where the filter wants it, its values are kept for `taps`.
  Tensor name(const std::string& path, Tensor value);
  /// Whether the filter wants a path: then what the path names must not be fused away.
  bool keeps(const std::string& path) const { return keep_ && keep_(path); }
  /// Orders `value` into the graph: results, and writes into the store.
  void require(Tensor value);
  /// Writes `value` into `target`, a tensor of the store.
  void write(Tensor value, Tensor target);
  /// Ends a stage: what `value` needs is computed before everything that is built later, and a run notes the time at
  /// which it is there. Use what this returns instead of `value`.
  Tensor stage(const std::string& name, Tensor value);
  const std::deque<Stage>& stages() const { return stages_; }

  /// Says what a custom node does; ggml's own are counted by their shapes (backend/work.h).
  void note_work(Tensor node, Work work) { noted_work_[node.node()] = work; }
  /// Remembers what a node of ours computes, for nodes built later that can do so on the way instead of reading it.
  void note(Tensor node, const void* what) { notes_[node.node()] = what; }
  const void* noted(Tensor node) const {
    const auto found = notes_.find(node.node());
    return found != notes_.end() ? found->second : nullptr;
  }
  /// The work of a run: one entry for each stage, then one for all that follows the last.
  std::vector<Work> work() const;

  /// After everything is built and the store is allocated: first `reserve` for every graph that is to run side by side,
  /// then `allocate` for each. Errors: out_of_memory.
  Status reserve(ComputeMemory& memory) { return memory.reserve(graph_); }
  Status allocate(ComputeMemory& memory);
  /// Has the system back everything that a run writes with memory now, so that no request waits for it.
  void touch() const;
  /// Errors: device.
  Status run(const Device& device);

  int n_node() const;
  /// Threads that a run takes: one where products are too small to be worth a barrier after each node.
  int n_thread(const Device& device) const;
  const std::vector<std::pair<std::string, Tensor>>& taps() const { return taps_; }

 private:
  Work work_of_node(const ggml_tensor* node) const;

  const Weights& weights_;
  Store& store_;
  TapFilter keep_;
  ggml_context_ptr context_;
  ggml_cgraph* graph_;
  int n_thread_ = 0;  // chosen at the first run
  std::map<std::string, Tensor> constants_;
  std::vector<std::pair<std::string, Tensor>> taps_;
  std::deque<Stage> stages_;  // a deque: the marks in the graph keep pointers to them
  std::unordered_map<const ggml_tensor*, Work> noted_work_;
  std::unordered_map<const ggml_tensor*, const void*> notes_;
};

}  // namespace vla
