// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <map>
#include <set>
#include <string>
#include <vector>

#include "graph/graph.h"

namespace vla {

/// The gain of a norm or a product whose channels are rotated. It is folded into matrices, then set to ones.
struct FoldedGain {
  const Param* gain = nullptr;
  const Param* bias = nullptr;     // of a norm: divided by the gain; may be null
  std::set<const Param*> columns;  // of a norm: matrices whose columns it multiplies
  std::set<const Param*> rows;     // of a product: the matrix and the bias whose rows it multiplies
};

/// Values whose channels may be rotated together: everything that makes, adds up, copies and reads them.
struct RotationPlace {
  std::string path;                 // of a norm of the values; may be empty
  bool is_heads = false;            // values of attention heads, not a residual stream
  std::int64_t d = 0;               // each `d` consecutive channels are rotated by the same matrix
  std::set<const Param*> elements;  // matrices that read, tables and vectors: their first dimension is rotated
  std::set<const Param*> rows;      // matrices that make: their second dimension is rotated
  std::vector<FoldedGain> folded;
};

/// Finds the places in all graphs of a policy. A rotation keeps sums, copies, weighted means of tokens and norms of
/// tokens, so those are followed from value to value. An operation that sees single channels, such as an activation,
/// keeps its operands and its result as they are. The rotation leaves a token of ones as it is, so LayerNorm's mean
/// too.
class RotationPlaces {
 public:
  void see(const Graph& graph);
  /// Whether a graph reads the parameter.
  bool has_seen(const Param& param) const { return params_.contains({&param, 0}); }
  /// The places that hold in every graph.
  std::vector<RotationPlace> found() const;

 private:
  friend struct Follower;

  /// A set of values that are rotated together or not at all: a tree of `parent`s, with the facts in its root.
  struct Values {
    int parent;
    std::int64_t d = 0;  // greatest common divisor of the sizes that must consist of whole rotated parts
    bool is_fixed = false, is_heads = false;
    std::string path;  // of a norm
  };
  struct SlotUse {
    int id;
    bool is_read = false, is_written = false, is_both_in_one_graph = false;
  };
  /// Gains by parameter; null for a use without one.
  using Gains = std::map<const Param*, std::set<const Param*>>;
  struct Fold {
    int id;  // of the values that the gain multiplies
    FoldedGain folded;
  };

  int add(std::int64_t d);
  int root(int id) const;
  Values& values_of(int id) { return values_[static_cast<std::size_t>(root(id))]; }
  void join(int a, int b);
  void narrow(int id, std::int64_t d);
  void fix(int id) { values_of(id).is_fixed = true; }
  int id_of(const Param* param, int dimension);
  int id_of(const Slot* slot);
  RotationPlaces with_conditions() const;

  std::vector<Values> values_;
  std::map<std::pair<const Param*, int>, int> params_;  // by the dimension that consists of the values' channels
  std::map<const Slot*, SlotUse> slots_;
  std::map<const Param*, Fold> folds_;  // by gain
  Gains columns_of_;                    // by matrix: the gains of what it multiplies
  Gains rows_of_;  // by matrix or vector: the gains of its rows; a gain and its bias have the gain itself
};

}  // namespace vla
