// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Files of limits, as python/vla_cpp/control/limits.py reads them.
#include <fmt/format.h>
#include <sys/stat.h>
#include <vla/control.h>

#include <algorithm>
#include <cmath>
#include <fstream>
#include <iterator>
#include <nlohmann/json.hpp>
#include <set>

namespace vla::control {
namespace {

using Json = nlohmann::ordered_json;
constexpr const char* kFormat = "vla-limits 1";
constexpr double kFar = 1e9;  // largest number in a file
constexpr int kMaxDepth = 8;
constexpr std::size_t kMaxFile = 1 << 20, kShown = 80;
constexpr const char* kKinds[] = {"position", "velocity", "difference", "gripper"};

std::string shown(const Json& value) {
  return value.dump(-1, ' ', true, Json::error_handler_t::replace).substr(0, kShown);
}

Error usage(const std::string& where, const std::string& expected, const std::string& found,
            const std::string& hint = "") {
  return Error("usage", where, expected, found, hint);
}

double number(const std::string& where, const Json& value) {
  if (!value.is_number() || !(std::abs(value.get<double>()) <= kFar))
    throw usage(where, fmt::format("a number up to {:g}", kFar), shown(value));
  return value.get<double>();
}

/// Parses JSON. Each object must have each name once.
Json parsed(std::string_view text) {
  std::vector<std::set<std::string>> names;
  std::string twice;
  bool is_deep = false;
  const auto check = [&](int depth, Json::parse_event_t event, Json& value) {
    is_deep |= depth > kMaxDepth;
    if (event == Json::parse_event_t::object_start) names.emplace_back();
    if (event == Json::parse_event_t::object_end) names.pop_back();
    if (event == Json::parse_event_t::key && !names.back().insert(value.get<std::string>()).second)
      twice = value.get<std::string>();
    return !is_deep;
  };
  Json document = Json::parse(text, check, /*allow_exceptions=*/false);
  if (is_deep || document.is_discarded()) throw usage("limits", "JSON", "text that is not");
  if (!twice.empty())
    throw usage("limits", "an object that has each name once", fmt::format("\"{}\" twice", twice.substr(0, kShown)));
  return document;
}

void check(const Column& column) {
  const std::string where = "limits." + column.name;
  for (const auto& [field, most] :
       {std::pair{"velocity", column.velocity}, {"acceleration", column.acceleration}, {"jerk", column.jerk}})
    if (most && column.kind == Kind::gripper)
      throw usage(where + "." + field, "none of a gripper, which may jump; one that is slowed is a position",
                  fmt::format("{:g}", *most));
    else if (most && !(0 < *most && *most <= kFar))
      throw usage(where + "." + field, "a number above 0", fmt::format("{:g}", *most));
  const double low = column.low.value_or(-kFar), high = column.high.value_or(kFar);
  const std::string range = fmt::format("[{:g}, {:g}]", low, high);
  if (!(low < high)) throw usage(where + ".range", "the least below the largest", range);
  const bool is_motion = column.kind == Kind::velocity || column.kind == Kind::difference;
  if (is_motion && !(low <= 0 && 0 <= high))
    throw usage(where + ".range",
                fmt::format("zero in the range of a {}: the robot has to be able to stop",
                            kKinds[static_cast<int>(column.kind)]),
                range);
}

Column column_of(const std::string& name, const Json& given) {
  const std::string where = "limits." + name;
  const std::set<std::string> known = {"kind", "unit", "range", "velocity", "acceleration", "jerk"};
  bool is_known = given.is_object() && given.contains("kind") && given.contains("unit");
  if (is_known)
    for (const auto& [field, value] : given.items()) is_known &= known.contains(field);
  if (!is_known)
    throw usage(where, "an object with kind and unit, and of acceleration, jerk, range, velocity what is limited",
                shown(given));
  if (!given["unit"].is_string()) throw usage(where + ".unit", "a text", shown(given["unit"]));
  Column column = {.name = name, .unit = given["unit"].get<std::string>()};
  const auto kind =
      std::find_if(std::begin(kKinds), std::end(kKinds), [&](const char* each) { return given["kind"] == each; });
  if (kind == std::end(kKinds))
    throw usage(where + ".kind", "one of position, velocity, difference, gripper", shown(given["kind"]));
  column.kind = static_cast<Kind>(kind - std::begin(kKinds));
  if (given.contains("range")) {
    const Json& range = given["range"];
    if (!range.is_array() || range.size() != 2) throw usage(where + ".range", "[least, largest]", shown(range));
    if (!range[0].is_null()) column.low = number(where + ".range", range[0]);
    if (!range[1].is_null()) column.high = number(where + ".range", range[1]);
  }
  if (given.contains("velocity")) column.velocity = number(where + ".velocity", given["velocity"]);
  if (given.contains("acceleration")) column.acceleration = number(where + ".acceleration", given["acceleration"]);
  if (given.contains("jerk")) column.jerk = number(where + ".jerk", given["jerk"]);
  check(column);
  return column;
}

std::string joined(const std::vector<std::string>& names) { return fmt::format("{}", fmt::join(names, ", ")); }

}  // namespace

Error::Error(std::string code_, const std::string& where, const std::string& expected, const std::string& found,
             const std::string& hint)
    : std::runtime_error(
          where + ": " +
          (expected.empty() ? found : "expected " + expected + ", found " + (found.empty() ? "nothing" : found)) +
          (hint.empty() ? "" : "; " + hint)),
      code(std::move(code_)) {}

Limits Limits::read(const std::string& path) {
  struct stat info = {};
  const std::string expected = "a file of limits in JSON";
  if (stat(path.c_str(), &info) != 0 || !S_ISREG(info.st_mode) || info.st_size > static_cast<off_t>(kMaxFile))
    throw usage(path, expected, fmt::format("no regular file of at most {} bytes", kMaxFile));
  std::ifstream file(path, std::ios::binary);
  const std::string text((std::istreambuf_iterator<char>(file)), std::istreambuf_iterator<char>());
  if (!file) throw usage(path, expected, "a file that cannot be read");
  try {
    return parse(text);
  } catch (const Error& error) {
    throw usage(path, expected, error.what());
  }
}

Limits Limits::parse(std::string_view json) {
  const Json document = parsed(json);
  if (!document.is_object() || document.size() != 3 || !document.contains("columns") ||
      !document.contains("refuse_above") || !document.contains("format") || document["format"] != kFormat)
    throw usage("limits", fmt::format("an object with columns, format, refuse_above, of format \"{}\"", kFormat),
                shown(document));
  const Json& columns = document["columns"];
  if (!columns.is_object() || columns.empty())
    throw usage("limits.columns", "an object with each action's name", shown(columns));
  Limits limits;
  for (const auto& [name, given] : columns.items()) limits.columns.push_back(column_of(name, given));
  limits.refuse_above = number("limits.refuse_above", document["refuse_above"]);
  if (!(0 <= limits.refuse_above && limits.refuse_above <= 1))
    throw usage("limits.refuse_above", "a share of rows, 0 to 1", fmt::format("{:g}", limits.refuse_above));
  return limits;
}

Limits Limits::of(const Spec& spec) const {
  std::vector<std::string> missing, extra;
  const auto find = [&](const std::string& name) {
    return std::find_if(columns.begin(), columns.end(), [&](const Column& each) { return each.name == name; });
  };
  for (const std::string& name : spec.action_names)
    if (find(name) == columns.end()) missing.push_back(name);
  for (const Column& column : columns)
    if (std::find(spec.action_names.begin(), spec.action_names.end(), column.name) == spec.action_names.end())
      extra.push_back(column.name);
  if (spec.action_names.empty() || !missing.empty() || !extra.empty())
    throw usage("limits", fmt::format("the actions of {}: {}", spec.bundle, joined(spec.action_names)),
                !missing.empty() ? "without " + joined(missing)
                : !extra.empty() ? "with " + joined(extra)
                                 : "a policy whose actions have no names");
  Limits ordered = {.columns = {}, .refuse_above = refuse_above};
  for (std::size_t i = 0; i < spec.action_names.size(); ++i) {
    const Column& column = *find(spec.action_names[i]);
    const std::string unit = i < spec.action_units.size() ? spec.action_units[i] : "";
    if (!unit.empty() && column.unit != unit)
      throw usage("limits." + column.name + ".unit", fmt::format("\"{}\", as {} says", unit, spec.bundle),
                  fmt::format("\"{}\"", column.unit));
    ordered.columns.push_back(column);
  }
  return ordered;
}

}  // namespace vla::control
