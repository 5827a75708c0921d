// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/openpi/codec.h"

#include <fmt/format.h>

#include <array>

#include "base/printable.h"
#include "serve/msgpack/writer.h"

namespace vla::serve::openpi {

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

Result<ActRequest> decode_act(const msgpack::Value& message, const Names& names, const ActLimits& limits,
                              const std::string& embodiment) {
  ActRequest request;
  VLA_TRY(request.observation, observe(message, names, limits));
  request.observation.embodiment = embodiment;
  VLA_TRY(const Extension extension, extension_of(message.find(kExtension), kExtension));
  request.seed = extension.seed ? *extension.seed : fresh_seed() >> 1;  // integers of msgpack's clients have a sign
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

std::string encode_error(const Error& error) {
  return fmt::format("{}: {}", code_name(error.code), printable(error.message()));
}

}  // namespace vla::serve::openpi
