// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <nlohmann/json.hpp>
#include <set>
#include <string>
#include <vector>

#include "base/result.h"
#include "bundle/keys.h"

namespace vla {

using Json = nlohmann::json;

/// Parses a JSON document of a bundle. Documents that nest too deep are refused, because the library's recursion would
/// exhaust the stack; real ones nest three deep. Errors: bad_bundle at `where`.
Result<Json> parse_json(const std::string& text, const std::string& where);
/// The same for a document that must be a list.
Result<Json> parse_json_list(const std::string& text, const std::string& where);

/// Reads one JSON object whose fields are all required and known: each is read by name and type, and `done` refuses
/// fields that were not read. Errors: bad_bundle at `where.field`.
class JsonFields {
 public:
  static Result<JsonFields> open(const Json& object, std::string where);

  const std::string& where() const { return where_; }
  bool has(const std::string& name) const { return object_->contains(name); }
  bool has_list(const std::string& name) const { return has(name) && object_->at(name).is_array(); }

  /// An integer in [low, high].
  Result<int> integer(const std::string& name, int low, int high);
  /// A number in `range`, as float32 or in double precision.
  Result<float> number(const std::string& name, Range range);
  Result<double> wide_number(const std::string& name, Range range);
  /// A list of distinct integers in [low, high].
  Result<std::vector<int>> integers(const std::string& name, int low, int high);
  /// A list of `count` elements in `range`.
  Result<std::vector<float>> numbers(const std::string& name, std::size_t count, Range range);
  Result<bool> boolean(const std::string& name);
  Result<std::string> string(const std::string& name);
  /// A list of distinct strings that are not empty.
  Result<std::vector<std::string>> strings(const std::string& name);
  /// The index of the value among these spellings.
  Result<int> choice(const std::string& name, const std::vector<const char*>& spellings);

  Status done() const;
  Error wrong(const std::string& name, std::string expected) const;

 private:
  JsonFields(const Json& object, std::string where) : object_(&object), where_(std::move(where)) {}
  static bool is_integer(const Json& value, int low, int high);
  Result<const Json*> field(const std::string& name, const char* expected);

  const Json* object_;
  std::string where_;
  std::set<std::string> read_;
};

/// The error for an op at a place where it is not allowed.
inline Error misplaced(const JsonFields& fields, const char* expected) { return fields.wrong("op", expected); }

}  // namespace vla
