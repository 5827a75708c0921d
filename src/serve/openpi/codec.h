// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "serve/front.h"
#include "serve/names.h"

namespace vla::serve::openpi {

/// A policy's inputs and outputs, as the map that a connection begins with. Clients take its keys as they come.
std::string encode_metadata(const v1::Description& description, const Names& names);

/// The keys that vLLM-Omni's clients put beside an observation.
struct OmniKeys {
  bool is_reset = false;  // they ask to forget an episode, and a server keeps none
  std::optional<std::uint64_t> seed;
};
/// Takes `endpoint`, `session_id`, `seed` and an empty `sampling_params` out of a message. Errors: bad_observation for
/// another endpoint and for parameters, which the bundle has.
Result<OmniKeys> take_omni_keys(msgpack::Value& message);

/// A map of observations -> what the engine takes. Errors: bad_observation, too_large.
Result<ActRequest> decode_act(const msgpack::Value& message, const Names& names, const ActLimits& limits,
                              const std::string& embodiment);

/// The answer with `actions` (horizon, d_action) and the times in milliseconds. `prev_total_ms`: of the connection's
/// answer before. Everything but the actions is plain numbers and texts, since clients cut every array of an answer.
std::string encode_reply(Reply reply, const Names& names, std::optional<double> prev_total_ms);

/// The actions (horizon, d_action) alone, a reset's answer and a refusal, as vLLM-Omni's clients read them.
std::string encode_omni_reply(Reply reply, const Names& names);
std::string encode_omni_reset();
std::string encode_omni_error(const Error& error);

/// A refusal as text: one line for people, its code first.
std::string encode_error(const Error& error);

}  // namespace vla::serve::openpi
