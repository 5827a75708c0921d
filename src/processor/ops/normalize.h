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
  /// eps both ways. Without any, where the spread is 0: zero gives 0 for x, kept leaves x as it is, kept_both_ways also
  /// on the way back.
  enum class Eps { divides, replaces_zero, added, zero, kept, kept_both_ways };
  /// numpy: float32 values and float64 statistics in one formula, as numpy does it. What has no statistic in it is
  /// rounded to float32; what a range gives back is not rounded.
  enum class Arithmetic { float32, float64, numpy };

  const char* kind;
  const char *low, *high;  // names of the statistics
  Spread spread;
  Eps eps;
  Arithmetic arithmetic;  // float64 is rounded once, at the end
  bool joint;             // the statistics are those of all features together, as they follow each other

  bool has_eps() const { return eps < Eps::zero; }
};

/// The rules of every kind, in the order of their sources: lerobot processor/normalize_processor.py (_apply_transform);
/// openpi transforms.py (Normalize, Unnormalize); Evo-1 scripts/Evo1_server.py (Normalizer); lerobot
/// gr00t/data/utils.py of Isaac-GR00T, and its gr00t/data/transform/state_action.py (Normalizer) for N1.5.
std::span<const NormRule> norm_rules();
/// The rule of a kind that exists.
const NormRule& norm_rule(std::string_view kind);

/// Maps values between world units and the network's, per column, in the reference's order of operations.
class Normalizer {
 public:
  enum class Direction { normalize, unnormalize };

  /// Reads the statistics `<stats>.mean`, ... of `width` columns; of a chunk they may also have a row for each of
  /// `n_row` actions. `where` is the recipe's place. Errors: bad_bundle, also where a number that normalizes would be
  /// divided by zero.
  static Result<Normalizer> create(const Bundle& bundle, const NormRule& rule, const std::string& stats, double eps,
                                   Direction direction, int width, const std::string& where, int n_row = 1);
  /// The same with the two statistics given, of equal length: one row of them.
  Normalizer(const NormRule& rule, Direction direction, double eps, std::vector<double> low,
             const std::vector<double>& high);

  /// Maps a value of a column, in the action with this index where the values are actions.
  double map(float x, std::size_t column, std::size_t row = 0) const;

 private:
  template <class T>
  T mapped(T x, std::size_t i) const;
  double mapped_by_numpy(float x, std::size_t i) const;

  const NormRule* rule_;
  Direction direction_;
  std::vector<double> low_;     // row by row
  std::vector<double> spread_;  // in the precision of the rule
  std::size_t row_step_ = 0;    // from a row to the next; 0 where all rows have the same statistics
};

}  // namespace vla
