// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <string>

#include "graph/graph.h"

namespace vla {

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
  bool has(const std::string& path) const { return entries_.count(path) != 0; }
  /// The value that `put` kept; in the graph that computes it, the value itself.
  Tensor get(Graph& g, const std::string& path) const {
    const Entry& entry = entries_.at(path);
    return entry.graph == g.serial() ? entry.value : g.input(entry.slot);
  }

 private:
  struct Entry {
    Slot* slot;
    std::uint64_t graph;
    Tensor value;
  };
  std::map<std::string, Entry> entries_;
};

}  // namespace vla
