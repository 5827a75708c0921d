// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "bundle/keys.h"

#include <fmt/format.h>

#include <algorithm>
#include <utility>

namespace vla {
namespace {

constexpr const char* kTypeNames[] = {"a boolean",        "an integer",         "a floating-point number",
                                      "a string",         "a list of integers", "a list of floating-point numbers",
                                      "a list of strings"};

Error missing(std::string_view key, const std::string& expected) {
  return {Code::bad_bundle, std::string(key), expected, "no such key", "convert the checkpoint again"};
}

template <class T>
Result<T> get(const std::map<std::string, Value, std::less<>>& values, std::string_view key) {
  const std::size_t index = Value(T{}).index();
  const auto found = values.find(key);
  if (found == values.end()) return missing(key, kTypeNames[index]);
  if (const T* value = std::get_if<T>(&found->second)) return *value;
  return Error{Code::bad_bundle, std::string(key), kTypeNames[index], kTypeNames[found->second.index()]};
}

Error out_of_range(std::string_view key, Range range, const std::string& found) {
  return {Code::bad_bundle, std::string(key), fmt::format("{} to {}", range.low, range.high), found};
}

}  // namespace

Result<bool> Keys::boolean(std::string_view key) const { return get<bool>(values_, key); }

Result<std::string> Keys::string(std::string_view key) const { return get<std::string>(values_, key); }

Result<std::vector<std::string>> Keys::strings(std::string_view key) const {
  return get<std::vector<std::string>>(values_, key);
}

Result<int> Keys::integer(std::string_view key, Range range) const {
  VLA_TRY(const std::int64_t value, get<std::int64_t>(values_, key));
  if (!range.holds(static_cast<double>(value))) return out_of_range(key, range, std::to_string(value));
  return static_cast<int>(value);
}

Result<double> Keys::number(std::string_view key, Range range) const {
  VLA_TRY(const double value, get<double>(values_, key));
  if (!range.holds(value)) return out_of_range(key, range, fmt::format("{}", value));
  return value;
}

Result<std::vector<int>> Keys::integers(std::string_view key, Range range) const {
  VLA_TRY(const std::vector<std::int64_t> wide, get<std::vector<std::int64_t>>(values_, key));
  std::vector<int> narrow;
  for (std::int64_t value : wide) {
    if (!range.holds(static_cast<double>(value))) return out_of_range(key, range, std::to_string(value));
    narrow.push_back(static_cast<int>(value));
  }
  return narrow;
}

bool Keys::same(std::string_view prefix, const Keys& other) const {
  const auto part = [&](const Keys& keys) {
    const auto first = keys.values_.lower_bound(prefix);
    const auto is_behind = [&](const auto& entry) { return !entry.first.starts_with(prefix); };
    return std::pair(first, std::find_if(first, keys.values_.end(), is_behind));
  };
  const auto mine = part(*this), theirs = part(other);
  return std::equal(mine.first, mine.second, theirs.first, theirs.second);
}

void Keys::forget(std::string_view prefix) {
  std::erase_if(values_, [&](const auto& entry) { return entry.first.starts_with(prefix); });
}

}  // namespace vla
