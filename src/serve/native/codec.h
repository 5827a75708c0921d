// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>

#include "serve/front.h"
#include "wire/envelope.h"
#include "wire/vla.pb.h"

namespace vla::serve {

/// Parses a serialized Act for the engine and decodes its images. `views` and `states` name features in errors. Errors:
/// bad_request (not an Act), too_large, bad_observation.
Result<ActRequest> decode_act(std::span<const std::byte> act, const ActLimits& limits, const FeatureNames& views,
                              const FeatureNames& states);

/// Answers a serialized Hello; `client` receives the client's name. Errors: bad_request, incompatible.
Result<v1::HelloReply> answer_hello(std::span<const std::byte> hello, std::string* client = nullptr);

/// Checks that the body of a Health is empty. Errors: bad_request.
Status check_empty(std::span<const std::byte> body);

/// The policy that a serialized Describe names, or empty. Errors: bad_request, too_large.
Result<std::string> read_describe(std::span<const std::byte> describe);

/// The robot that a serialized Act names, or empty. Errors: bad_request, too_large.
Result<std::string> named_embodiment(std::span<const std::byte> act);

/// Makes the description once from a loaded engine; it is the same in every answer.
v1::Description describe(const Engine& engine, const v1::Limits& limits);
/// One robot's part of the description; all of it if there is one robot.
const v1::Description& description_of(const v1::Description& all, const std::string& embodiment);

/// Encodes the engine's answer; `names` and so on come from `description`.
v1::ActionChunk encode_chunk(Reply reply, const v1::Description& description);

/// The record of an act and its answer in another protocol, written as native messages.
Record record_of(std::uint64_t request_id, const Reply& reply, const v1::Description& description);

v1::Error encode_error(const Error& error);
/// The serialized response that refuses the request with this number.
std::string refusal(std::uint64_t request_id, const Error& error);

/// A response to the request with this number, in the newest version of this build.
v1::Response response_to(std::uint64_t request_id);

}  // namespace vla::serve
