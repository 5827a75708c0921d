// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Source: Isaac-GR00T, gr00t/eval/service.py (N1.5) and gr00t/policy/server_client.py (N1.6, N1.7).
#include "serve/gr00t/codec.h"

#include <fmt/format.h>

#include <algorithm>
#include <cctype>
#include <nlohmann/json.hpp>

#include "base/printable.h"
#include "serve/msgpack/writer.h"

namespace vla::serve::gr00t {
namespace {

using msgpack::Framing;
using msgpack::Value;

constexpr const char* kText = "text";
constexpr const char* kLanguageKey = "annotation.human.task_description";

Error bad(std::string where, std::string expected, std::string found) {
  return {Code::bad_observation, std::move(where), std::move(expected), std::move(found)};
}

bool is_instruction(std::string_view key) { return key.starts_with("annotation.") || key == "task"; }

/// Returns the value inside nested lists of one element.
const Value& innermost(const Value& value) {
  const Value* at = &value;
  while (at->is_list() && at->items.size() == 1) at = &at->items[0];
  return *at;
}

struct Flattening {
  Observed observed;
  bool has_array = false, all_states_batched = true;

  Status add(std::string key, const Value& value) {
    if (is_instruction(key)) key = kText;
    if (const auto framing = msgpack::framing_of(value)) VLA_CHECK(look_at(key, value, *framing));
    observed.keys.push_back(std::move(key));
    const std::string& kept = observed.keys.back();
    if (observed.flat.find(kept) != nullptr) return bad(printable(kept), "one value", "two");
    observed.flat.items.push_back({.type = Value::Type::text, .data = kept});
    observed.flat.items.push_back(kept == kText ? innermost(value) : value);
    return {};
  }

  /// Records an array's framing and rank, and refuses batches and series of frames here, where the error can name the
  /// key: later checks would only report a wrong size.
  Status look_at(const std::string& key, const Value& value, Framing framing) {
    VLA_TRY(const Array array, msgpack::array_of(value, printable(key)));
    observed.dialect.framing = framing;
    has_array = true;
    const bool is_video = key.starts_with("video."), is_state = key.starts_with("state.");
    const std::size_t n_own = is_video ? 3 : 1, rank = array.shape().size();
    if (is_state) all_states_batched = all_states_batched && rank >= 3;
    for (std::size_t i = 0; (is_video || is_state) && i + n_own < rank; ++i)
      if (array.shape()[i] != 1)
        return bad(printable(key), "one observation of one time step",
                   fmt::format("{} in dimension {}", array.shape()[i], i));
    return {};
  }

  Status add_all(const Value& map) {
    for (std::size_t i = 0; i < map.items.size(); i += 2)
      VLA_CHECK(add(std::string(map.items[i].data), map.items[i + 1]));
    return {};
  }
  Status add_nested(const Value& observation) {
    for (std::size_t i = 0; i < observation.items.size(); i += 2) {
      const std::string group(observation.items[i].data);
      const Value& members = observation.items[i + 1];
      if (!members.is_map()) return bad(printable(group), "a map of this modality", "another type");
      for (std::size_t k = 0; k < members.items.size(); k += 2) {
        const std::string key(members.items[k].data);
        VLA_CHECK(add(group == "language" ? kText : group + "." + key, members.items[k + 1]));
      }
    }
    return {};
  }
};

/// The columns of a chunk that clients know as one array.
struct Group {
  std::string key;
  std::size_t begin = 0, end = 0;
};
std::vector<Group> groups_of(const v1::Description& description) {
  std::vector<Group> groups;
  for (int i = 0; i < description.actions_size(); ++i) {
    const std::string& name = description.actions(i).name();
    const std::size_t dot = name.rfind('.');
    const bool is_numbered = dot != std::string::npos && dot + 1 < name.size() &&
                             std::all_of(name.begin() + static_cast<std::ptrdiff_t>(dot) + 1, name.end(),
                                         [](unsigned char c) { return std::isdigit(c) != 0; });
    const std::string key = is_numbered ? name.substr(0, dot) : name;
    const auto column = static_cast<std::size_t>(i);
    if (groups.empty() || groups.back().key != key) groups.push_back({key, column, column});
    groups.back().end = column + 1;
  }
  return groups;
}

std::string without_prefix(const std::string& key) { return key.substr(key.find('.') + 1); }

std::string message_of(const Error& error) {
  if (error.where.empty()) return error.found;  // the reference's own wording
  return fmt::format("{}: {}", code_name(error.code), printable(error.message()));
}

}  // namespace

Result<Observed> read_observation(const Value* data) {
  if (data == nullptr || !data->is_map()) return bad("data", "a map", "another type, or none");
  Flattening flattening;
  Dialect& dialect = flattening.observed.dialect;
  flattening.observed.flat.type = Value::Type::map;
  const Value* observation = data->find("observation");
  dialect.is_n1_5 = observation == nullptr;
  const Value* video = dialect.is_n1_5 ? nullptr : observation->find("video");
  dialect.is_flat = dialect.is_n1_5 || video == nullptr || !video->is_map();
  if (!dialect.is_n1_5) {
    if (!observation->is_map()) return bad("observation", "a map", "another type");
    for (std::size_t i = 0; i < data->items.size(); i += 2)
      if (const std::string_view key = data->items[i].data; key != "observation" && key != "options")
        return bad("data", "observation and options", printable(key.substr(0, 100)));
    VLA_TRY(flattening.observed.extension, extension_of(data->find("options"), "options"));
  }
  VLA_CHECK(dialect.is_flat ? flattening.add_all(dialect.is_n1_5 ? *data : *observation)
                            : flattening.add_nested(*observation));
  if (!flattening.has_array) return bad("observation", "NumPy arrays", "none");
  dialect.is_batched = !dialect.is_n1_5 || flattening.all_states_batched;
  return std::move(flattening.observed);
}

std::string encode_reply(Reply reply, const Dialect& dialect, const Names& names, const v1::Description& description) {
  ActionChunk& chunk = reply.chunk;
  const auto horizon = static_cast<std::size_t>(chunk.horizon), d_action = static_cast<std::size_t>(chunk.d_action);
  names.to_client(chunk.actions, d_action);
  const std::vector<Group> groups = groups_of(description);
  msgpack::Writer out;
  if (!dialect.is_n1_5) out.list(2);
  out.map(groups.size());
  for (const Group& group : groups) {
    const std::size_t width = group.end - group.begin;
    std::vector<float> values;
    for (std::size_t row = 0; row < horizon; ++row)
      for (std::size_t i = group.begin; i < group.end; ++i) values.push_back(chunk.actions[row * d_action + i]);
    std::vector<std::size_t> shape{horizon, width};
    if (dialect.is_batched) shape.insert(shape.begin(), 1);
    out.text(dialect.is_flat ? "action." + group.key : group.key).array(dialect.framing, shape, values);
  }
  if (!dialect.is_n1_5) out.map(0);
  return out.take();
}

std::string encode_modalities(const Dialect& dialect, const Names& names, const v1::Description& description) {
  struct Modality {
    const char* name;
    std::vector<std::string> keys;
    int n_step = 1;
  };
  std::vector<Modality> modalities{{"video", {}}, {"state", {}}, {"action", {}}, {"language", {kLanguageKey}}};
  for (const Names::Entry& view : names.views) modalities[0].keys.push_back(without_prefix(view.key));
  for (const Names::Entry& state : names.states) modalities[1].keys.push_back(without_prefix(state.key));
  for (const Group& group : groups_of(description)) modalities[2].keys.push_back(group.key);
  modalities[2].n_step = static_cast<int>(description.horizon());

  msgpack::Writer out;
  out.map(modalities.size());
  for (Modality& modality : modalities) {
    out.text(modality.name).map(dialect.is_n1_5 ? 2 : 3).text("__ModalityConfig_class__").boolean(true);
    if (!dialect.is_n1_5) out.text("__ModalityConfig__").boolean(true);  // N1.7's mark, beside N1.6's
    out.text("as_json");
    std::vector<int> steps;
    for (int i = 0; i < modality.n_step; ++i) steps.push_back(i);
    if (dialect.is_n1_5) {
      const bool is_language = modality.keys == std::vector<std::string>{kLanguageKey};
      for (std::string& key : modality.keys)
        if (!is_language) key = std::string(modality.name) + "." + key;
      out.text(nlohmann::json{{"delta_indices", steps}, {"modality_keys", modality.keys}}.dump());
      continue;
    }
    out.map(5).text("delta_indices").list(steps.size());
    for (const int step : steps) out.integer(step);
    out.text("modality_keys").list(modality.keys.size());
    for (const std::string& key : modality.keys) out.text(key);
    out.text("sin_cos_embedding_keys").nil().text("mean_std_embedding_keys").nil().text("action_configs").nil();
  }
  return out.take();
}

std::string encode_error(const Error& error) {
  return msgpack::Writer().map(1).text("error").text(message_of(error)).take();
}
std::string encode_ping() {
  return msgpack::Writer().map(2).text("status").text("ok").text("message").text("Server is running").take();
}
std::string encode_nothing() { return msgpack::Writer().nil().take(); }
std::string encode_reset() { return msgpack::Writer().map(0).take(); }

}  // namespace vla::serve::gr00t
