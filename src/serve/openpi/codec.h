// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "serve/front.h"
#include "serve/names.h"

namespace vla::serve::openpi {

/// A policy's inputs and outputs as the map that opens a connection. Clients use its keys as they are.
std::string encode_metadata(const v1::Description& description, const Names& names);

/// The keys that vLLM-Omni's clients send beside an observation.
struct OmniKeys {
  bool is_reset = false;  // asks to reset an episode; this server keeps none
  std::optional<std::uint64_t> seed;
};
/// Removes `endpoint`, `session_id`, `seed` and an empty `sampling_params` from a message. Errors: bad_observation for
/// another endpoint, and for sampling parameters, which the bundle fixes.
Result<OmniKeys> take_omni_keys(msgpack::Value& message);

/// Decodes a map of observations for the engine. Errors: bad_observation, too_large.
Result<ActRequest> decode_act(const msgpack::Value& message, const Names& names, const ActLimits& limits,
                              const std::string& embodiment);

/// Encodes the answer: `actions` (horizon, d_action) and times in milliseconds. `prev_total_ms` is that of the
/// connection's previous answer. Everything except the actions is a plain number or text, since clients slice every
/// array in an answer.
std::string encode_reply(Reply reply, const Names& names, std::optional<double> prev_total_ms);

/// Answers for vLLM-Omni's clients: only the actions (horizon, d_action), a reset, a refusal.
std::string encode_omni_reply(Reply reply, const Names& names);
std::string encode_omni_reset();
std::string encode_omni_error(const Error& error);

/// A refusal as one line of text, its code first.
std::string encode_error(const Error& error);

}  // namespace vla::serve::openpi
