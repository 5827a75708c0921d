// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "serve/front.h"
#include "serve/names.h"

namespace vla::serve::openpi {

/// What a policy takes and gives, as the map that a connection begins with. Clients take its keys as they come.
std::string encode_metadata(const v1::Description& description, const Names& names);

/// A map of observations -> what the engine takes. Errors: bad_observation, too_large.
Result<ActRequest> decode_act(const msgpack::Value& message, const Names& names, const ActLimits& limits,
                              const std::string& embodiment);

/// The answer with `actions` (horizon, d_action) and the times in milliseconds. `prev_total_ms`: of the connection's
/// answer before. Everything but the actions is plain numbers and texts, since clients cut every array of an answer.
std::string encode_reply(Reply reply, const Names& names, std::optional<double> prev_total_ms);

/// A refusal as text: one line for people, its code first.
std::string encode_error(const Error& error);

}  // namespace vla::serve::openpi
