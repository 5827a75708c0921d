// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <string>

#include "backend/graph.h"

namespace vla {

/// What the prefix leaves for the solver steps: named tensors that outlive the graph which writes them.
class Cache {
 public:
  /// Keeps `value` under its path, which is a tap too. Called while the prefix graph is built.
  void put(Graph& g, const std::string& path, Tensor value) {
    const Tensor kept = g.store().add_like(value);
    g.write(g.name(path, value), kept);
    entries_[path] = kept;
  }
  bool has(const std::string& path) const { return entries_.count(path) != 0; }
  /// What `put` kept; the prefix graph of the same plan must have put it.
  Tensor get(const std::string& path) const { return entries_.at(path); }

 private:
  std::map<std::string, Tensor> entries_;
};

}  // namespace vla
