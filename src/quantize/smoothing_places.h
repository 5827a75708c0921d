// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <set>
#include <string>
#include <vector>

#include "graph/graph.h"

namespace vla {

/// A place where channels can be divided, because every reader is a matrix whose columns can be multiplied: the result
/// of a norm with weights, or a gated MLP's value before `down`.
struct SmoothingPlace {
  std::string path;               // path of the value's tap
  const Param* weight = nullptr;  // weight of the norm or of the MLP's `up`, whose rows are divided
  const Param* bias = nullptr;    // its bias, divided too; may be null
  std::set<const Param*> readers;
};

/// Finds the places in all graphs of a policy.
class SmoothingPlaces {
 public:
  void see(const Graph& graph);
  /// The places that hold in every graph. A place whose parameters something else reads is dropped.
  std::vector<SmoothingPlace> found() const;

 private:
  /// For each parameter, the places that use its elements, by the place's weight; null for other uses.
  using Uses = std::map<const Param*, std::set<const Param*>>;

  std::map<const Param*, SmoothingPlace> places_;  // by weight
  std::set<const Param*> refused_;                 // weights of places that do not hold in some graph
  Uses columns_, rows_;                            // uses of a matrix's columns and rows; vectors count as rows
};

}  // namespace vla
