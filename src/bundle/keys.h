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

/// Typed access to the metadata of a bundle. A missing key or another type is `bad_bundle` with the key as `where`.
class Keys {
 public:
  Keys() = default;
  explicit Keys(std::map<std::string, Value, std::less<>> values) : values_(std::move(values)) {}

  bool has(std::string_view key) const { return values_.find(key) != values_.end(); }
  const std::map<std::string, Value, std::less<>>& all() const { return values_; }
  void set(std::string key, Value value) { values_.insert_or_assign(std::move(key), std::move(value)); }

  Result<bool> boolean(std::string_view key) const;
  /// A size or count: an integer from 0 to 2^31 - 1.
  Result<int> integer(std::string_view key) const;
  /// A finite floating-point number.
  Result<double> number(std::string_view key) const;
  Result<std::string> string(std::string_view key) const;
  Result<std::vector<int>> integers(std::string_view key) const;
  Result<std::vector<std::string>> strings(std::string_view key) const;

 private:
  std::map<std::string, Value, std::less<>> values_;
};

}  // namespace vla
