// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/json_fields.h"

#include <fmt/format.h>

#include <algorithm>
#include <cstdint>

namespace vla {
namespace {

constexpr int kMaxDepth = 16;
constexpr std::size_t kShown = 60;  // characters of a wrong value that a message shows

std::string shown(const Json& value) {
  const std::string text = value.dump(-1, ' ', true, Json::error_handler_t::replace);
  return text.size() <= kShown ? text : text.substr(0, kShown) + "...";
}

}  // namespace

Result<Json> parse_json(const std::string& text, const std::string& where) {
  bool too_deep = false;
  const auto shallow = [&](int depth, Json::parse_event_t, Json&) {
    too_deep |= depth > kMaxDepth;
    return !too_deep;
  };
  Json document = Json::parse(text, shallow, /*allow_exceptions=*/false);
  if (too_deep)
    return Error{Code::bad_bundle, where, fmt::format("JSON that nests at most {} deep", kMaxDepth), "deeper nesting"};
  if (document.is_discarded()) return Error{Code::bad_bundle, where, "JSON", "text that is not JSON"};
  return document;
}

Result<Json> parse_json_list(const std::string& text, const std::string& where) {
  VLA_TRY(Json document, parse_json(text, where));
  if (!document.is_array()) return Error{Code::bad_bundle, where, "a JSON list", shown(document)};
  return document;
}

Result<JsonFields> JsonFields::open(const Json& object, std::string where) {
  if (!object.is_object()) return Error{Code::bad_bundle, std::move(where), "a JSON object", shown(object)};
  return JsonFields(object, std::move(where));
}

Error JsonFields::wrong(const std::string& name, std::string expected) const {
  return {Code::bad_bundle, where_ + "." + name, std::move(expected), shown(object_->at(name))};
}

Result<const Json*> JsonFields::field(const std::string& name, const char* expected) {
  const auto found = object_->find(name);
  if (found == object_->end())
    return Error{Code::bad_bundle, where_ + "." + name, expected, "no such field", "convert the checkpoint again"};
  read_.insert(name);
  return &*found;
}

bool JsonFields::is_integer(const Json& value, int low, int high) {
  if (!value.is_number_integer()) return false;
  // An unsigned number above int64's range would wrap if read as signed.
  if (value.is_number_unsigned() && value.get<std::uint64_t>() > static_cast<std::uint64_t>(INT64_MAX)) return false;
  return value.get<std::int64_t>() >= low && value.get<std::int64_t>() <= high;
}

Result<int> JsonFields::integer(const std::string& name, int low, int high) {
  VLA_TRY(const Json* value, field(name, "an integer"));
  if (!is_integer(*value, low, high)) return wrong(name, fmt::format("an integer from {} to {}", low, high));
  return value->get<int>();
}

Result<std::vector<int>> JsonFields::integers(const std::string& name, int low, int high) {
  VLA_TRY(const Json* value, field(name, "a list of integers"));
  const std::string expected = fmt::format("a list of different integers from {} to {}", low, high);
  if (!value->is_array()) return wrong(name, expected);
  std::vector<int> list;
  std::set<int> seen;
  for (const Json& item : *value) {
    if (!is_integer(item, low, high) || !seen.insert(item.get<int>()).second) return wrong(name, expected);
    list.push_back(item.get<int>());
  }
  return list;
}

Result<double> JsonFields::wide_number(const std::string& name, Range range) {
  VLA_TRY(const Json* value, field(name, "a number"));
  if (!value->is_number() || !range.holds(value->get<double>()))
    return wrong(name, fmt::format("a number from {} to {}", range.low, range.high));
  return value->get<double>();
}

Result<float> JsonFields::number(const std::string& name, Range range) {
  VLA_TRY(const double value, wide_number(name, range));
  return static_cast<float>(value);
}

Result<std::vector<float>> JsonFields::numbers(const std::string& name, std::size_t count, Range range) {
  const std::string expected = fmt::format("a list of {} numbers from {} to {}", count, range.low, range.high);
  VLA_TRY(const Json* value, field(name, expected.c_str()));
  if (!value->is_array() || value->size() != count) return wrong(name, expected);
  std::vector<float> list;
  for (const Json& item : *value) {
    if (!item.is_number() || !range.holds(item.get<double>())) return wrong(name, expected);
    list.push_back(static_cast<float>(item.get<double>()));
  }
  return list;
}

Result<bool> JsonFields::boolean(const std::string& name) {
  VLA_TRY(const Json* value, field(name, "true or false"));
  if (!value->is_boolean()) return wrong(name, "true or false");
  return value->get<bool>();
}

Result<std::string> JsonFields::string(const std::string& name) {
  VLA_TRY(const Json* value, field(name, "a string"));
  if (!value->is_string()) return wrong(name, "a string");
  return value->get<std::string>();
}

Result<std::vector<std::string>> JsonFields::strings(const std::string& name) {
  constexpr const char* kExpected = "a list of different strings that are not empty";
  VLA_TRY(const Json* value, field(name, kExpected));
  if (!value->is_array()) return wrong(name, kExpected);
  std::vector<std::string> list;
  std::set<std::string> seen;
  for (const Json& item : *value) {
    if (!item.is_string() || item.get<std::string>().empty() || !seen.insert(item.get<std::string>()).second)
      return wrong(name, kExpected);
    list.push_back(item.get<std::string>());
  }
  return list;
}

Result<int> JsonFields::choice(const std::string& name, const std::vector<const char*>& spellings) {
  VLA_TRY(const std::string text, string(name));
  std::string expected;
  int index = 0;
  for (const char* spelling : spellings) {
    if (text == spelling) return index;
    expected += (index++ == 0 ? "\"" : ", \"") + std::string(spelling) + "\"";
  }
  return wrong(name, (spellings.size() > 1 ? "one of " : "") + expected);
}

Status JsonFields::done() const {
  for (const auto& item : object_->items())
    if (!read_.contains(item.key()))
      return Error{Code::bad_bundle, where_ + "." + item.key(), "", "unknown field", "this bundle needs a newer vla"};
  return {};
}

}  // namespace vla
