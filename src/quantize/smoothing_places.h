// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <set>
#include <string>
#include <vector>

#include "graph/graph.h"

namespace vla {

/// A place where channels may be divided, since all its readers multiply them by matrices that can be multiplied: the
/// result of a norm with weights, or of a gated MLP before `down`.
struct SmoothingPlace {
  std::string path;               // of the value's tap
  const Param* weight = nullptr;  // of the norm, or of the MLP's `up`, whose rows are divided
  const Param* bias = nullptr;    // is divided too; may be null
  std::set<const Param*> readers;
};

/// Finds the places in all graphs of a policy.
class SmoothingPlaces {
 public:
  void see(const Graph& graph);
  /// Those that hold in every graph: parameters that something else reads too are no place's.
  std::vector<SmoothingPlace> found() const;

 private:
  /// The roles of a parameter's elements in the operations that read it: by the weight of the place, null for others.
  using Uses = std::map<const Param*, std::set<const Param*>>;

  std::map<const Param*, SmoothingPlace> places_;  // by weight
  std::set<const Param*> refused_;                 // weights
  Uses columns_, rows_;                            // of matrices by place; of vectors only rows
};

}  // namespace vla
