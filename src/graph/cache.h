// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <string>
#include <vector>

#include "graph/graph.h"

namespace vla {

/// Selects the column of `capacity` that receives the next token's values: in run k of the graph, column k.
struct AppendPlace {
  Tensor here, elsewhere;  // [1, 1, capacity]: 1 at k and 0 elsewhere, and the reverse
};

/// Values, by path, that one graph stores for later graphs: the load-time graph for prefix and steps, the prefix for
/// the steps.
class Cache {
 public:
  /// Stores `value` under `path`, which is also a tap. Call it while the graph that computes the value is recorded.
  void put(Graph& g, const std::string& path, Tensor value) {
    Slot* slot = g.slots().add_f32(value.shape());
    value = g.name(path, value);
    g.write(value, slot);
    entries_[path] = {slot, g.serial(), value};
  }
  /// Stores `value` [d, n, 1] for the next token. Returns the values of all tokens so far, [d, n, capacity]; the
  /// remaining columns are finite. The slot outlives the run; the caller fills it with zeros before the first run.
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
  /// Returns the stored value as an input; in the graph that computes it, the computed tensor.
  Tensor get(Graph& g, const std::string& path) const {
    const Entry& entry = entries_.at(path);
    return entry.graph == g.serial() ? entry.value : g.input(entry.slot);
  }
  /// The slot in which `put` stored the value.
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
