// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdlib>
#include <span>

#include "processor/image.h"
#include "serve/native/codec.h"
#include "wire/envelope.h"

namespace vla::fuzz {

/// What became of a request: whether it was sound, and of which kind.
struct RequestFate {
  observe::Kind kind = observe::Kind::unknown;
  bool sound = false;
};

/// Reads bytes as the server does. What is accepted must keep every limit, and what is refused must be refused with a
/// message of bounded length. Aborts when it is not so.
inline RequestFate check_request(std::span<const std::byte> bytes) {
  // Small, so that the time goes into the decoders.
  constexpr serve::ActLimits kLimits{.max_pixels = 1 << 16,
                                     .max_text = 100,
                                     .max_views = 4,
                                     .horizon = 3,
                                     .noise_rows = 3,
                                     .d_noise = 5,
                                     .d_action = 2};
  const auto refuse = [](const Error& error) {
    if (error.message().size() > 4096) std::abort();
    if (error.code != Code::bad_request && error.code != Code::incompatible && error.code != Code::too_large &&
        error.code != Code::bad_observation)
      std::abort();
    if (serve::encode_error(error).SerializeAsString().empty()) std::abort();
  };
  wire::Envelope envelope;
  RequestFate fate;
  const Status read = wire::read_envelope(bytes, envelope);
  fate.kind = envelope.kind;
  if (!read) return refuse(read.error()), fate;
  if (envelope.kind == observe::Kind::hello) {
    const auto reply = serve::answer_hello(envelope.body(bytes));
    if (!reply) return refuse(reply.error()), fate;
  } else if (envelope.kind == observe::Kind::describe) {
    const auto name = serve::read_describe(envelope.body(bytes));
    if (!name) return refuse(name.error()), fate;
  } else if (envelope.kind != observe::Kind::act) {
    const Status empty = serve::check_empty(envelope.body(bytes));
    if (!empty) return refuse(empty.error()), fate;
  } else {
    const auto act =
        serve::decode_act(envelope.body(bytes), kLimits, FeatureNames("view", {}, {}), FeatureNames("state", {}, {}));
    if (!act) return refuse(act.error()), fate;
    if (act->observation.text.value_or("").size() > kLimits.max_text ||
        act->observation.views.size() > kLimits.max_views)
      std::abort();
    for (const auto& [name, frame] : act->observation.views)
      if (frame && !check_frame(*frame, name, {kLimits.max_pixels})) std::abort();
  }
  fate.sound = true;
  return fate;
}

}  // namespace vla::fuzz
