// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <string>
#include <vector>

#include "graph/graph.h"

namespace vla {

/// Where a graph that runs step by step keeps the next token's values: column k of `capacity` in run k.
struct AppendPlace {
  Tensor here, elsewhere;  // [1, 1, capacity]: 1 at k and 0 elsewhere, and the reverse
};

/// Values that one graph leaves for later graphs, by path: the prefix for the solver steps, load time for both.
class Cache {
 public:
  /// Keeps `value` under its path, which is also a tap. Call it while the graph that computes the value is recorded.
  void put(Graph& g, const std::string& path, Tensor value) {
    Slot* slot = g.slots().add_f32(value.shape());
    value = g.name(path, value);
    g.write(value, slot);
    entries_[path] = {slot, g.serial(), value};
  }
  /// Keeps `value` [d, n, 1] as the next token's. Returns those of all tokens so far, [d, n, capacity]; what follows
  /// them is finite. The slot outlives the run, and whoever runs the graph fills it with zeros before the first one.
  Tensor append(Graph& g, const std::string& path, Tensor value, const AppendPlace& place) {
    const Shape shape = {value.dim(0), value.dim(1), place.here.dim(2), 1};
    Slot* slot = g.slots().add_f32(shape);
    appended_.push_back(slot);
    const Tensor before = g.add(op::Multiply{}, {g.input(slot), place.elsewhere});
    const Tensor own = g.add(op::Multiply{}, {g.add(op::Repeat{}, {value}, shape), place.here});
    const Tensor all = g.name(path, g.add(op::Add{}, {before, own}));
    g.write(all, slot);
    return all;
  }
  const std::vector<Slot*>& appended() const { return appended_; }
  bool has(const std::string& path) const { return entries_.count(path) != 0; }
  /// The value that `put` kept; in the graph that computes it, the value itself.
  Tensor get(Graph& g, const std::string& path) const {
    const Entry& entry = entries_.at(path);
    return entry.graph == g.serial() ? entry.value : g.input(entry.slot);
  }
  /// Where `put` kept the value.
  Slot* slot(const std::string& path) const { return entries_.at(path).slot; }

 private:
  struct Entry {
    Slot* slot;
    std::uint64_t graph;
    Tensor value;
  };
  std::map<std::string, Entry> entries_;
  std::vector<Slot*> appended_;
};

}  // namespace vla
