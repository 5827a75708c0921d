// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "base/result.h"
#include "bundle/bundle.h"

namespace vla {

/// How a normalize or unnormalize op uses two statistics, `low` and `high`, per column:
///
///   spread     normalize                     unnormalize
///   value      (x - low) / spread            x * spread + low            spread = high: a standard deviation
///   range      2 * (x - low) / spread - 1    (x + 1) / 2 * spread + low  spread = high - low
struct NormRule {
  enum class Spread { value, range };
  /// divides: spread + eps where a spread divides. replaces_zero: eps where the spread is exactly 0. added: spread +
  /// eps both ways. none: a range of 0 gives 0, a value of 0 leaves x as it is.
  enum class Eps { divides, replaces_zero, added, none };

  const char* kind;
  const char *low, *high;  // names of the statistics
  Spread spread;
  Eps eps;
  bool wide;   // in double precision, rounded once; else in float32
  bool joint;  // the statistics are those of all features together, as they follow each other
};

/// The rules of every kind, in the order of their sources: lerobot processor/normalize_processor.py (_apply_transform);
/// openpi transforms.py (Normalize, Unnormalize); Evo-1 scripts/Evo1_server.py (Normalizer); lerobot
/// policies/groot/processor_groot.py (_min_max_norm, _unnormalize_min_max), Isaac-GR00T gr00t/data/utils.py.
std::span<const NormRule> norm_rules();
/// The rule of a kind that exists.
const NormRule& norm_rule(std::string_view kind);

/// Maps numbers between world units and the network's, per column, in the reference's order of operations.
class Normalizer {
 public:
  enum class Direction { normalize, unnormalize };

  /// Reads the statistics `<stats>.mean`, ... of `width` columns. `where` is the recipe's place. Errors: bad_bundle,
  /// also where a number that normalizes would be divided by zero.
  static Result<Normalizer> create(const Bundle& bundle, const NormRule& rule, const std::string& stats, double eps,
                                   Direction direction, int width, const std::string& where);
  /// The same with the two statistics given, of equal length.
  Normalizer(const NormRule& rule, Direction direction, double eps, std::vector<double> low,
             const std::vector<double>& high);

  /// In place; as many values as columns.
  void apply(std::span<float> values) const;

 private:
  template <class T>
  T mapped(T x, std::size_t column) const;

  const NormRule* rule_;
  Direction direction_;
  std::vector<double> low_;
  std::vector<double> spread_;  // in the precision of the rule
};

}  // namespace vla
