// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <optional>
#include <span>

#include "engine/engine.h"
#include "serve/vla.pb.h"

namespace vla::serve {

/// What an act may hold. All are compared before memory is taken that the sizes ask for.
struct ActLimits {
  std::int64_t max_pixels = 0;  // of all images
  std::size_t max_text = 0;     // bytes
  std::size_t max_views = 0;
  int horizon = 0, d_noise = 0;  // of the noise that the policy takes
  int d_action = 0;              // of a chunk
};

/// An act, ready for the engine.
struct ActRequest {
  Observation observation;
  Noise noise;
  std::optional<std::uint64_t> seed;  // that the noise is drawn from: the client's or a fresh one
  std::optional<Leftover> leftover;
  std::int64_t capture_time_ns = 0;
};

/// A serialized Act -> what the engine takes; images are decoded. `views` and `states` name features in errors. Errors:
/// bad_request (not an Act), too_large, bad_observation.
Result<ActRequest> decode_act(std::span<const std::byte> act, const ActLimits& limits, const FeatureNames& views,
                              const FeatureNames& states);

/// A serialized Hello -> the reply; `client` is how the client calls itself. Errors: bad_request, incompatible.
Result<v1::HelloReply> answer_hello(std::span<const std::byte> hello, std::string* client = nullptr);

/// Whether the body of a Describe or Health is the empty message that it has to be. Errors: bad_request.
Status check_empty(std::span<const std::byte> body);

/// Which robot a serialized Act names, or empty text. Errors: bad_request, too_large.
Result<std::string> named_embodiment(std::span<const std::byte> act);

/// What stays the same in every answer, made once from a loaded engine.
v1::Description describe(const Engine& engine, const v1::Limits& limits);
/// The part of it that is one robot's; all of it where there is one.
const v1::Description& description_of(const v1::Description& all, const std::string& embodiment);

/// A chunk of the engine -> its message. `stages` has the server's own stages in it; `names` and so on come from
/// `description`.
v1::ActionChunk encode_chunk(const ActRequest& request, ActionChunk chunk, const v1::Description& description);

v1::Error encode_error(const Error& error);

/// The response to a request of this number, of the newest version that this build speaks.
v1::Response response_to(std::uint64_t request_id);

}  // namespace vla::serve
