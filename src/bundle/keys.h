// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <map>
#include <string>
#include <string_view>
#include <variant>
#include <vector>

#include "base/result.h"

namespace vla {

/// One metadata value of a bundle. Integers of every width are widened; floats become double.
using Value = std::variant<bool, std::int64_t, double, std::string, std::vector<std::int64_t>, std::vector<double>,
                           std::vector<std::string>>;

/// The range of a number, both ends included. Whoever reads a number states its range, so untested values are refused
/// at load.
struct Range {
  double low, high;
  bool holds(double value) const { return value >= low && value <= high; }
};

inline constexpr Range kAnySize = {0, 2147483647};

/// Ranges of values that are read in several places.
inline constexpr Range kNormEps = {1e-13, 0.01};
inline constexpr Range kRopeBase = {1, 1e9};
inline constexpr Range kTokenScale = {1e-4, 1e4};
inline constexpr Range kTokenIndex = {0, 65535};
inline constexpr Range kPeriod = {1e-6, 1e6};
inline constexpr Range kRateHz = {0, 1e5};
inline constexpr Range kFlag = {0, 1};

/// Typed access to the metadata of a bundle. A missing key, another type or a number out of range is `bad_bundle`
/// with the key as `where`.
class Keys {
 public:
  Keys() = default;
  explicit Keys(std::map<std::string, Value, std::less<>> values) : values_(std::move(values)) {}

  bool has(std::string_view key) const { return values_.find(key) != values_.end(); }
  const std::map<std::string, Value, std::less<>>& all() const { return values_; }
  void set(std::string key, Value value) { values_.insert_or_assign(std::move(key), std::move(value)); }
  /// Whether both have the same keys with this prefix, and the same values.
  bool same(std::string_view prefix, const Keys& other) const;
  /// Removes the keys with this prefix.
  void forget(std::string_view prefix);

  Result<bool> boolean(std::string_view key) const;
  /// `range` must lie within kAnySize.
  Result<int> integer(std::string_view key, Range range) const;
  Result<double> number(std::string_view key, Range range) const;
  Result<std::string> string(std::string_view key) const;
  Result<std::vector<int>> integers(std::string_view key, Range range) const;
  Result<std::vector<std::string>> strings(std::string_view key) const;

 private:
  std::map<std::string, Value, std::less<>> values_;
};

}  // namespace vla
