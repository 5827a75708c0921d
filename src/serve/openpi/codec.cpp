// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/openpi/codec.h"

#include <fmt/format.h>

#include <array>

#include "base/printable.h"
#include "serve/msgpack/writer.h"

namespace vla::serve::openpi {

using msgpack::Value;

std::string encode_metadata(const v1::Description& description, const Names& names) {
  msgpack::Writer out;
  out.map(9);
  out.text("action_horizon").integer(description.horizon());
  out.text("action_dim").integer(description.actions_size());
  out.text("action_names").list(static_cast<std::size_t>(description.actions_size()));
  for (const v1::Dimension& action : description.actions()) out.text(action.name());
  out.text("control_hz").real(description.rate_hz());
  out.text("names").text(names.told());
  out.text("bundle").text(description.bundle().name());
  out.text("checksum").text(description.bundle().checksum());
  out.text("precision").text(description.runtime().precision());
  out.text("server").text("vla.cpp " + description.runtime().server_version());
  return out.take();
}

Result<OmniKeys> take_omni_keys(Value& message) {
  OmniKeys keys;
  std::vector<Value> kept;
  for (std::size_t i = 0; i + 1 < message.items.size() && message.is_map(); i += 2) {
    const std::string_view key = message.items[i].data;
    Value& value = message.items[i + 1];
    if (key == "endpoint") {
      keys.is_reset = value.is_text() && value.data == "reset";
      if (!keys.is_reset && !(value.is_text() && value.data == "infer"))
        return Error{Code::bad_observation, "endpoint", "infer or reset", printable(value.data.substr(0, 100))};
    } else if (key == "seed" && value.type == Value::Type::integer && value.integer >= 0) {
      keys.seed = static_cast<std::uint64_t>(value.integer);
    } else if (key == "seed" && value.type != Value::Type::nil) {
      return Error{Code::bad_observation, "seed", "an integer from 0 up", "another value"};
    } else if (key == "sampling_params" && value.type != Value::Type::nil && !value.items.empty()) {
      return Error{Code::bad_observation, "sampling_params", "none: the bundle has the solver's steps", "some"};
    } else if (key != "session_id" && key != "seed" && key != "sampling_params") {
      kept.push_back(std::move(message.items[i]));
      kept.push_back(std::move(value));
    }
  }
  if (message.is_map()) message.items = std::move(kept);
  return keys;
}

Result<ActRequest> decode_act(const msgpack::Value& message, const Names& names, const ActLimits& limits,
                              const std::string& embodiment) {
  ActRequest request;
  VLA_TRY(request.observation, observe(message, names, limits));
  request.observation.embodiment = embodiment;
  VLA_TRY(const Extension extension, extension_of(message.find(kExtension), kExtension));
  request.seed = extension.seed ? *extension.seed : fresh_seed() >> 1;  // msgpack clients expect signed integers
  request.noise = *request.seed;
  return request;
}

std::string encode_reply(Reply reply, const Names& names, std::optional<double> prev_total_ms) {
  ActionChunk& chunk = reply.chunk;
  const std::array shape{static_cast<std::size_t>(chunk.horizon), static_cast<std::size_t>(chunk.d_action)};
  names.to_client(chunk.actions, shape[1]);
  double total = 0, model = 0;
  for (const auto& [name, ms] : chunk.timing) {
    total += ms;
    if (name != "decode" && name != "wait") model += ms;
  }
  msgpack::Writer out;
  const bool has_notes = !chunk.notes.empty();
  out.map(4 + has_notes);
  out.text("actions").array(msgpack::Framing::openpi, shape, chunk.actions);
  out.text("policy_timing").map(1).text("infer_ms").real(model);
  out.text("seed").integer(static_cast<std::int64_t>(*reply.request.seed));
  if (has_notes) {
    out.text("notes").list(chunk.notes.size());
    for (const std::string& note : chunk.notes) out.text(note);
  }
  out.text("server_timing").map(2 + chunk.timing.size() + prev_total_ms.has_value());
  out.text("infer_ms").real(total);
  if (prev_total_ms) out.text("prev_total_ms").real(*prev_total_ms);
  out.text("queue_ms").real(reply.queue_ms);
  for (const auto& [name, ms] : chunk.timing) out.text(name + "_ms").real(ms);
  return out.take();
}

std::string encode_omni_reply(Reply reply, const Names& names) {
  ActionChunk& chunk = reply.chunk;
  const std::array shape{static_cast<std::size_t>(chunk.horizon), static_cast<std::size_t>(chunk.d_action)};
  names.to_client(chunk.actions, shape[1]);
  msgpack::Writer out;
  out.array(msgpack::Framing::openpi, shape, chunk.actions);
  return out.take();
}

std::string encode_omni_reset() {
  msgpack::Writer out;
  out.map(1).text("status").text("reset successful");
  return out.take();
}

std::string encode_omni_error(const Error& error) {
  msgpack::Writer out;
  out.map(2).text("type").text("error").text("message").text(encode_error(error));
  return out.take();
}

std::string encode_error(const Error& error) {
  return fmt::format("{}: {}", code_name(error.code), printable(error.message()));
}

}  // namespace vla::serve::openpi
