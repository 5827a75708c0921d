// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>

#include "serve/front.h"
#include "wire/envelope.h"
#include "wire/vla.pb.h"

namespace vla::serve {

/// A serialized Act -> what the engine takes; images are decoded. `views` and `states` name features in errors. Errors:
/// bad_request (not an Act), too_large, bad_observation.
Result<ActRequest> decode_act(std::span<const std::byte> act, const ActLimits& limits, const FeatureNames& views,
                              const FeatureNames& states);

/// A serialized Hello -> the reply; `client` is how the client calls itself. Errors: bad_request, incompatible.
Result<v1::HelloReply> answer_hello(std::span<const std::byte> hello, std::string* client = nullptr);

/// Whether the body of a Health is the empty message that it has to be. Errors: bad_request.
Status check_empty(std::span<const std::byte> body);

/// The policy that a serialized Describe names, or empty text. Errors: bad_request, too_large.
Result<std::string> read_describe(std::span<const std::byte> describe);

/// Which robot a serialized Act names, or empty text. Errors: bad_request, too_large.
Result<std::string> named_embodiment(std::span<const std::byte> act);

/// The description, which stays the same in every answer, made once from a loaded engine.
v1::Description describe(const Engine& engine, const v1::Limits& limits);
/// The part of it that is one robot's; all of it where there is one.
const v1::Description& description_of(const v1::Description& all, const std::string& embodiment);

/// An answer of the engine -> its message; `names` and so on come from `description`.
v1::ActionChunk encode_chunk(Reply reply, const v1::Description& description);

/// The record of an act of another protocol and its answer, as they would have been in this one.
Record record_of(std::uint64_t request_id, const Reply& reply, const v1::Description& description);

v1::Error encode_error(const Error& error);
/// The serialized response that refuses a request of this number.
std::string refusal(std::uint64_t request_id, const Error& error);

/// The response to a request of this number, of the newest version that this build speaks.
v1::Response response_to(std::uint64_t request_id);

}  // namespace vla::serve
