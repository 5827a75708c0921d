// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/names.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <charconv>
#include <numbers>
#include <set>
#include <sstream>

#include "base/printable.h"
#include "serve/msgpack/array.h"
#include "serve/presets.h"

namespace vla::serve {
namespace {

constexpr double kDegree = std::numbers::pi / 180;

std::string last_part(const std::string& name) { return name.substr(name.rfind('.') + 1); }

/// A policy's views and states, as the description has them.
struct Features {
  const v1::Description& description;

  /// Returns the full name of the feature whose name, alias, or last part of either is `given`; empty if no feature or
  /// several features match.
  template <class Specs>
  static std::string find(const Specs& specs, const std::string& given) {
    std::string found;
    for (const auto& spec : specs) {
      bool fits = given == spec.name() || given == last_part(spec.name());
      if constexpr (requires { spec.aliases(); })
        for (const std::string& alias : spec.aliases()) fits = fits || given == alias || given == last_part(alias);
      if (given == spec.name()) return given;
      if (fits && !found.empty()) return {};
      if (fits) found = spec.name();
    }
    return found;
  }
  std::string view(const std::string& given) const { return find(description.views(), given); }
  std::string state(const std::string& given) const { return find(description.states(), given); }

  std::string told() const {
    std::vector<std::string> names;
    for (const v1::ViewSpec& view : description.views()) names.push_back("view " + view.name());
    for (const v1::StateSpec& state : description.states())
      names.push_back(fmt::format("state {} ({})", state.name(), state.dimensions_size()));
    return fmt::format("{}", fmt::join(names, ", "));
  }
};

template <class Entries>
std::string keys_of(const Entries& entries) {
  std::vector<std::string> keys;
  for (const auto& entry : entries) keys.push_back(entry.key);
  return fmt::format("{}", fmt::join(keys, ", "));
}

std::string all_keys(const Names& names) {
  std::string all = keys_of(names.views);
  for (const std::string& keys : {keys_of(names.states), keys_of(names.ignored)})
    if (!keys.empty()) all += (all.empty() ? "" : ", ") + keys;
  return all + (all.empty() ? "" : ", ") + names.text;
}

std::string convention_told(const Convention& c, bool is_view) {
  std::string told = is_view ? c.is_bgr ? "bgr" : "rgb" : c.is_degrees ? "degrees" : "radians";
  return c.is_flipped ? told + ",flipped" : told;
}

/// Builds names from a preset and lines.
struct Reader {
  Names names;
  Features features;
  const char* option;
  std::string missing_keys = {};  // required keys of the preset that match no feature of the policy

  Error refused(std::string expected, std::string found) const {
    return {Code::usage, option, std::move(expected), std::move(found),
            fmt::format("the policy has {}", features.told())};
  }

  void forget(const std::string& key) {
    for (auto* entries : {&names.views, &names.states, &names.ignored})
      std::erase_if(*entries, [&](const Names::Entry& entry) { return entry.key == key; });
  }

  Status add_preset(const Preset& preset) {
    names.preset = preset.name;
    for (const Preset::Key& key : preset.keys) {
      std::istringstream candidates(key.features);
      std::string found;
      for (std::string name; found.empty() && candidates >> name;)
        found = key.width > 0 ? features.state(name) : features.view(name);
      if (found.empty()) {
        if (key.required) missing_keys += (missing_keys.empty() ? "" : ", ") + std::string(key.key);
        continue;
      }
      (key.width > 0 ? names.states : names.views).push_back({key.key, found, {}});
    }
    return check_widths(preset);
  }

  /// Detects a policy for another robot here, before the robot moves.
  Status check_widths(const Preset& preset) const {
    for (const v1::StateSpec& state : features.description.states()) {
      int width = 0;
      for (const Preset::Key& key : preset.keys)
        for (const Names::Entry& entry : names.states)
          if (entry.key == key.key && entry.feature == state.name()) width += key.width;
      if (width != 0 && width != state.dimensions_size())
        return refused(fmt::format("a policy whose {} has the {} values of {}", state.name(), width, preset.name),
                       std::to_string(state.dimensions_size()));
    }
    return {};
  }

  Status add_line(const std::string& line) {
    const std::size_t equals = line.find('=');
    if (equals == std::string::npos || equals == 0)
      return refused("KEY=FEATURE[,bgr][,degrees][,flipped][,in_order]", "'" + printable(line) + "'");
    const std::string key = line.substr(0, equals);
    std::istringstream words(line.substr(equals + 1));
    std::string feature;
    std::getline(words, feature, ',');
    Convention convention;
    for (std::string word; std::getline(words, word, ',');) {
      bool* const flag = word == "bgr"        ? &convention.is_bgr
                         : word == "degrees"  ? &convention.is_degrees
                         : word == "flipped"  ? &convention.is_flipped
                         : word == "in_order" ? &convention.is_in_order
                                              : nullptr;
      if (flag == nullptr) return refused("bgr, degrees, flipped or in_order", "'" + printable(word) + "'");
      *flag = true;
    }
    forget(key);
    if (key == "actions") return add_columns(feature, convention);
    if (feature == "text") return names.text = key, Status();
    if (feature.empty()) return names.ignored.push_back({key, {}, {}}), Status();
    const std::string view = features.view(feature), state = features.state(feature);
    if (view.empty() == state.empty()) return refused("the name of one view or state", "'" + printable(feature) + "'");
    if (view.empty() ? convention.is_bgr : convention.is_degrees || convention.is_flipped || convention.is_in_order)
      return refused("bgr for a view, degrees, flipped and in_order for a state", "'" + printable(line) + "'");
    VLA_CHECK(check_absent(line, view));
    (view.empty() ? names.states : names.views).push_back({key, view.empty() ? state : view, convention});
    return {};
  }

  Status add_columns(const std::string& range, const Convention& convention) {
    Names::Columns columns{0, 0, convention};
    const char* const end = range.data() + range.size();
    const auto from = std::from_chars(range.data(), end, columns.begin);
    const bool has_colon = from.ec == std::errc() && from.ptr != end && *from.ptr == ':';
    const auto to = has_colon ? std::from_chars(from.ptr + 1, end, columns.end) : from;
    const auto n = static_cast<std::size_t>(features.description.actions_size());
    if (!has_colon || to.ec != std::errc() || to.ptr != end || columns.begin >= columns.end || columns.end > n ||
        convention.is_bgr || convention.is_in_order)
      return refused(fmt::format("actions=FROM:TO,degrees or flipped, with 0 <= FROM < TO <= {}", n),
                     "'" + printable(range) + "'");
    names.actions.push_back(columns);
    return {};
  }

  /// Marks a view as absent and removes its key. An observation that still has the key is refused: something is wrong.
  void add_absent(const std::string& given) {
    const std::string view = features.view(given);
    if (view.empty()) return;  // a view of another robot of the bundle: the engine has checked that it exists
    names.absent.push_back(view);
    std::erase_if(names.views, [&](const Names::Entry& entry) { return entry.feature == view; });
  }

  bool is_absent(const std::string& view) const {
    return std::find(names.absent.begin(), names.absent.end(), view) != names.absent.end();
  }

  Status check_absent(const std::string& line, const std::string& view) const {
    if (!is_absent(view)) return {};
    return refused("a view that is not --absent", "'" + printable(line) + "'");
  }

  /// Checks that every required feature of the policy has a key, and returns the names.
  Result<Names> finish() {
    std::set<std::string> covered;
    for (const Names::Entry& entry : names.views)
      if (!covered.insert(entry.feature).second) return refused("one key for each view", "two for " + entry.feature);
    for (const Names::Entry& entry : names.states) covered.insert(entry.feature);
    std::vector<std::string> missing;
    for (const v1::ViewSpec& view : features.description.views())
      if (!view.optional() && !covered.contains(view.name()) && !is_absent(view.name())) missing.push_back(view.name());
    for (const v1::StateSpec& state : features.description.states())
      if (!covered.contains(state.name())) missing.push_back(state.name());
    if (missing.empty()) return std::move(names);
    Error error =
        refused(fmt::format("a key of the client for {}", fmt::join(missing, ", ")),
                fmt::format("keys {}{}", all_keys(names),
                            missing_keys.empty() ? std::string() : "; the policy has nothing for " + missing_keys));
    error.hint += "; --map KEY=FEATURE names a key, --absent VIEW says that the robot has no such camera";
    return error;
  }
};

using msgpack::Value;

/// The value at a key, looked up whole, then level by level.
const Value* at(const Value& message, std::string_view key) {
  if (const Value* whole = message.find(key)) return whole;
  const std::size_t slash = key.find('/');
  const Value* level = slash == std::string_view::npos ? nullptr : message.find(key.substr(0, slash));
  return level == nullptr ? nullptr : at(*level, key.substr(slash + 1));
}

/// Collects the keys of all values; slashes join the levels.
void collect_keys(const Value& map, const std::string& prefix, std::vector<std::string>& keys) {
  for (std::size_t i = 0; i < map.items.size(); i += 2) {
    if (prefix.empty() && map.items[i].data == kExtension) continue;
    const std::string key = prefix + std::string(map.items[i].data);
    const Value& value = map.items[i + 1];
    if (value.is_map() && !msgpack::framing_of(value)) {
      collect_keys(value, key + "/", keys);
    } else {
      keys.push_back(key);
    }
  }
}

Status check_keys(const Value& message, const Names& names) {
  std::set<std::string> known{names.text};
  for (const auto* entries : {&names.views, &names.states, &names.ignored})
    for (const Names::Entry& entry : *entries) known.insert(entry.key);
  std::vector<std::string> keys;
  collect_keys(message, "", keys);
  for (const std::string& key : keys)
    if (!known.contains(key))
      return Error{Code::bad_observation, "observation", "the keys " + all_keys(names), printable(key.substr(0, 100)),
                   "--map KEY= lets a key pass"};
  return {};
}

}  // namespace

float Convention::to_policy(float x) const {
  double value = x;
  if (is_degrees) value *= kDegree;
  return static_cast<float>(is_flipped ? 1 - value : value);
}

float Convention::to_client(float x) const {
  double value = is_flipped ? 1 - double{x} : double{x};
  return static_cast<float>(is_degrees ? value / kDegree : value);
}

std::string Names::told() const {
  std::vector<std::string> parts;
  for (const Entry& view : views)
    parts.push_back(
        fmt::format("{}={}({})", view.key, last_part(view.feature), convention_told(view.convention, true)));
  for (const Entry& state : states)
    parts.push_back(
        fmt::format("{}={}({})", state.key, last_part(state.feature), convention_told(state.convention, false)));
  for (const Columns& columns : actions)
    parts.push_back(
        fmt::format("actions={}:{}({})", columns.begin, columns.end, convention_told(columns.convention, false)));
  for (const std::string& view : absent) parts.push_back(fmt::format("{}(absent)", last_part(view)));
  std::string out = fmt::format("{}", fmt::join(parts, " "));
  for (const Preset& known : kPresets)
    if (preset == known.name) out = fmt::format("{}: {}; gripper {}", preset, out, known.gripper);
  return out;
}

void Names::to_client(std::vector<float>& values, std::size_t d_action) const {
  for (const Columns& columns : actions)
    for (std::size_t row = 0; row < values.size(); row += d_action)
      for (std::size_t i = columns.begin; i < columns.end; ++i)
        values[row + i] = columns.convention.to_client(values[row + i]);
}

/// A view begins with `=`, which no line does.
std::string text_of(const Given& given) {
  std::string text;
  for (const std::string& line : given.lines) text += line + "\n";
  for (const std::string& view : given.absent) text += "=" + view + "\n";
  return text;
}

Given given_of(const std::string& text) {
  Given given;
  std::istringstream in(text);
  for (std::string line; std::getline(in, line);) {
    const bool is_view = line.starts_with('=');
    (is_view ? given.absent : given.lines).push_back(is_view ? line.substr(1) : line);
  }
  return given;
}

std::string view_named(const std::string& given, const v1::Description& description) {
  return Features{description}.view(given);
}

std::string presets() {
  std::vector<const char*> names;
  for (const Preset& preset : kPresets) names.push_back(preset.name);
  return fmt::format("{}", fmt::join(names, ", "));
}

std::vector<std::string> lines_of(const std::vector<std::string>& lines, bool of_modalities) {
  std::vector<std::string> some;
  for (const std::string& line : lines)
    if ((line.starts_with("video.") || line.starts_with("state.")) == of_modalities) some.push_back(line);
  return some;
}

Result<Names> names_for(const Given& given, const v1::Description& description, const char* option) {
  Reader reader{{}, {description}, option};
  if (!given.preset.empty()) {
    const auto found = std::find_if(std::begin(kPresets), std::end(kPresets),
                                    [&](const Preset& known) { return given.preset == known.name; });
    if (found == std::end(kPresets))
      return reader.refused("a preset: " + presets(), "'" + printable(given.preset) + "'");
    VLA_CHECK(reader.add_preset(*found));
  }
  for (const std::string& view : given.absent) reader.add_absent(view);
  for (const std::string& line : given.lines) VLA_CHECK(reader.add_line(line));
  return reader.finish();
}

Result<Names> own_names(const Given& given, const v1::Description& description, const char* option) {
  Reader reader{{}, {description}, option};
  reader.names.text = "text";
  for (const v1::ViewSpec& view : description.views())
    reader.names.views.push_back({"video." + last_part(view.name()), view.name(), {}});
  for (const v1::StateSpec& state : description.states())
    reader.names.states.push_back({"state." + last_part(state.name()), state.name(), {}});
  for (const std::string& view : given.absent) reader.add_absent(view);
  for (const std::string& line : given.lines) {
    const std::string key = line.substr(0, line.find('='));
    VLA_CHECK(reader.add_line(line));
    // A line for a feature takes the place of the policy's own name for it.
    for (auto* entries : {&reader.names.views, &reader.names.states}) {
      const auto mapped = std::find_if(entries->begin(), entries->end(), [&](auto& e) { return e.key == key; });
      if (mapped == entries->end()) continue;
      const std::string feature = mapped->feature;
      std::erase_if(*entries, [&](auto& e) {
        return e.feature == feature && e.key != key && (e.key.ends_with("." + last_part(feature)));
      });
    }
  }
  return reader.finish();
}

Result<Names> native_names(const Given& given, const v1::Description& description) {
  Reader reader{{}, {description}, "--door native"};
  if (!given.lines.empty() || !given.preset.empty())
    return reader.refused("the policy's own names", given.preset.empty() ? "--map" : "--preset");
  reader.names.text = "text";
  for (const v1::ViewSpec& view : description.views()) reader.names.views.push_back({view.name(), view.name(), {}});
  for (const v1::StateSpec& state : description.states())
    reader.names.states.push_back({state.name(), state.name(), {}});
  for (const std::string& view : given.absent) reader.add_absent(view);
  return reader.finish();
}

Result<Extension> extension_of(const Value* map, const char* where) {
  Extension extension;
  if (map == nullptr || map->type == Value::Type::nil) return extension;
  if (!map->is_map()) return Error{Code::bad_observation, where, "a map", "another type"};
  for (std::size_t i = 0; i < map->items.size(); i += 2) {
    const std::string_view key = map->items[i].data;
    const Value& value = map->items[i + 1];
    auto* const field = key == "seed" ? &extension.seed : key == "deadline_ms" ? &extension.deadline_ms : nullptr;
    if (field == nullptr || value.type != Value::Type::integer || value.integer < 0)
      return Error{Code::bad_observation, where, "integers from 0 up at seed and deadline_ms",
                   printable(key.substr(0, 100))};
    *field = static_cast<std::uint64_t>(value.integer);
  }
  return extension;
}

Result<Observation> observe(const Value& message, const Names& names, const ActLimits& limits) {
  if (!message.is_map())
    return Error{Code::bad_observation, "observation", "a map with the keys " + all_keys(names), "another type"};
  VLA_CHECK(check_keys(message, names));
  Observation observation;
  for (const std::string& view : names.absent) observation.views.emplace(view, std::nullopt);
  ActLimits left = limits;
  for (const Names::Entry& entry : names.views) {
    const Value* value = at(message, entry.key);
    if (value == nullptr) continue;  // the engine checks for required views
    VLA_TRY(const Array array, msgpack::array_of(*value, entry.key));
    const ImageLimits pixels{left.max_pixels, Code::too_large};
    VLA_TRY(Frame frame, frame_of(array, entry.key, pixels, entry.convention.is_bgr));
    VLA_CHECK(spend(left, frame.width, frame.height, std::int64_t{frame.width} * frame.height, entry.key));
    observation.views.emplace(entry.feature, std::move(frame));
  }
  for (const Names::Entry& entry : names.states) {
    const Value* value = at(message, entry.key);
    if (value == nullptr) return Error{Code::bad_observation, entry.key, "the state " + entry.feature, "none"};
    VLA_TRY(const std::vector<float> values, msgpack::floats_of(*value, entry.key));
    std::vector<float>& state = observation.states[entry.feature];
    for (const float x : values) state.push_back(entry.convention.to_policy(x));
  }
  const Value* text = at(message, names.text);
  if (text == nullptr) return Error{Code::bad_observation, names.text, "an instruction", "none"};
  VLA_TRY(observation.text, msgpack::text_of(*text, names.text));
  if (observation.text->size() > limits.max_text)
    return Error{Code::too_large, names.text, fmt::format("at most {} bytes", limits.max_text),
                 fmt::format("{} bytes", observation.text->size())};
  return observation;
}

}  // namespace vla::serve
