// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <string>
#include <vector>

#include "base/result.h"
#include "bundle/bundle.h"
#include "processor/recipe.h"

namespace vla {

/// Names of the two tensors that a step reads; none for identity.
std::vector<std::string> statistics_of(const NormalizeOp& op);

/// Maps numbers between world units and the network's, per column, in float32 and in the reference's order of
/// operations:
///
///   kind        normalize                               unnormalize                            low, high
///   mean_std    (x - mean) / (std + eps)                x * std + mean                         mean, std
///   min_max     2 * (x - min) / range - 1               (x + 1) / 2 * range + min              min, max
///   quantiles   2 * (x - q01) / range - 1               (x + 1) * range / 2 + q01              q01, q99
///   quantile10  2 * (x - q10) / range - 1               (x + 1) * range / 2 + q10              q10, q90
///   identity    x                                       x
///
/// A range (high - low) of exactly 0 is replaced by eps; mean_std un-normalizes without eps, though it normalizes with
/// it. Source: lerobot processor/normalize_processor.py _apply_transform.
///
///   openpi_mean_std   (x - mean) / (std + eps)              x * (std + eps) + mean                   mean, std
///   openpi_quantiles  (x - q01) / (range + eps) * 2 - 1     (x + 1) / 2 * (range + eps) + q01        q01, q99
///
/// These two are computed in double precision and rounded once, since that reference's statistics are doubles.
/// Source: openpi transforms.py Normalize, Unnormalize.
///
///   evo1_mean_std     (x - mean) / (std + eps)              x * (std + eps) + mean                   mean, std
///   evo1_min_max      2 * (x - min) / (range + eps) - 1     (x + 1) / 2 * (range + eps) + min        min, max
///   evo1_quantiles    2 * (x - q01) / (range + eps) - 1     (x + 1) / 2 * (range + eps) + q01        q01, q99
///
/// In float32 again. Source: Evo-1 scripts/Evo1_server.py (Normalizer).
///
///   groot_min_max     2 * (x - min) / range - 1             (x + 1) / 2 * range + min                min, max
///   groot_mean_std    (x - mean) / std                      x * std + mean                           mean, std
///
/// Without eps: a range of exactly 0 gives 0, and min on the way back; a std of 0 leaves x as it is, both ways. The
/// first is computed in float32, the second in double precision and rounded once. Source: lerobot
/// policies/groot/processor_groot.py (_min_max_norm, _unnormalize_min_max); Isaac-GR00T gr00t/data/utils.py.
class Normalizer {
 public:
  enum class Direction { normalize, unnormalize };

  /// Reads the statistics `<stats>.mean`, ... of `width` columns. `where` is the recipe's place. Errors: bad_bundle,
  /// also where a number that normalizes would be divided by zero.
  static Result<Normalizer> create(const Bundle& bundle, const NormalizeOp& op, Direction direction, int width,
                                   const std::string& where);
  /// The same with the two statistics given, of equal length.
  Normalizer(NormKind kind, Direction direction, double eps, std::vector<float> low, std::vector<float> high);

  /// In place; as many values as columns.
  void apply(std::span<float> values) const;

 private:
  double openpi(double x, std::size_t column) const;
  float groot(float x, std::size_t column) const;
  float normalized(float x, std::size_t column) const;
  float unnormalized(float x, std::size_t column) const;
  Status check_divisors(const NormalizeOp& op) const;

  NormKind kind_;
  Direction direction_;
  std::vector<float> low_;      // mean, min or lower quantile
  std::vector<float> factor_;   // std, or the range; with eps where un-normalizing has it
  std::vector<float> divisor_;  // std + eps, or the range
  std::vector<double> spread_;  // of the openpi kinds: std or range, and eps
};

}  // namespace vla
