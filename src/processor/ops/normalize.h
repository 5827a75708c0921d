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
  /// How eps is used. divides: spread + eps when normalizing, where the spread is the divisor. replaces_zero: eps if
  /// the spread is exactly 0. added: spread + eps in both directions. The other rules have no eps. If the spread is 0,
  /// zero maps x to 0 and kept leaves x unchanged; kept_both_ways leaves it unchanged when unnormalizing, too.
  enum class Eps { divides, replaces_zero, added, zero, kept, kept_both_ways };
  /// numpy: float32 values and float64 statistics in one formula, as numpy evaluates it. Parts without statistics are
  /// rounded to float32; the result of unnormalizing a range is not rounded.
  enum class Arithmetic { float32, float64, numpy };

  const char* kind;
  const char *low, *high;  // names of the statistics
  Spread spread;
  Eps eps;
  Arithmetic arithmetic;  // float64 results are rounded once, at the end
  bool joint;             // statistics cover all features, concatenated

  bool has_eps() const { return eps < Eps::zero; }
};

/// The rules of all kinds, in the order of their sources: lerobot processor/normalize_processor.py (_apply_transform);
/// openpi transforms.py (Normalize, Unnormalize); openvla-oft experiments/robot/openvla_utils.py (normalize_proprio)
/// and modeling_prismatic.py (_unnormalize_actions); Evo-1 scripts/Evo1_server.py (Normalizer); Isaac-GR00T
/// gr00t/data/utils.py, and gr00t/data/transform/state_action.py (Normalizer) for N1.5.
std::span<const NormRule> norm_rules();
/// The rule of a kind, which must exist.
const NormRule& norm_rule(std::string_view kind);

/// Maps values between world units and the network's, per column, with operations in the reference's order.
class Normalizer {
 public:
  enum class Direction { normalize, unnormalize };

  /// Reads the statistics `<stats>.mean`, ... of `width` columns. Statistics of actions may have one row for each of
  /// `n_row` rows of a chunk. `where` is the recipe's place. Errors: bad_bundle, also if normalizing would divide by
  /// zero.
  static Result<Normalizer> create(const Bundle& bundle, const NormRule& rule, const std::string& stats, double eps,
                                   Direction direction, int width, const std::string& where, int n_row = 1);
  /// The same for two given statistics of equal length, as one row.
  Normalizer(const NormRule& rule, Direction direction, double eps, std::vector<double> low,
             const std::vector<double>& high);

  /// Maps a value of a column; `row` is the action's index in its chunk.
  double map(float x, std::size_t column, std::size_t row = 0) const;

 private:
  template <class T>
  T mapped(T x, std::size_t i) const;
  double mapped_by_numpy(float x, std::size_t i) const;

  const NormRule* rule_;
  Direction direction_;
  std::vector<double> low_;     // row by row
  std::vector<double> spread_;  // spreads, with eps, in the rule's precision
  std::size_t row_step_ = 0;    // stride of rows; 0 if all rows share statistics
};

}  // namespace vla
