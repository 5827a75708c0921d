// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "fuzz/message_target.h"
#include "serve/lerobot/codec.h"
#include "serve/native/codec.h"
#include "wire/envelope.h"

namespace vla::fuzz {

inline v1::Limits small_limits() {
  v1::Limits limits;
  limits.set_max_pixels(static_cast<std::uint64_t>(kMessageLimits.max_pixels));
  limits.set_max_text_bytes(static_cast<std::uint32_t>(kMessageLimits.max_text));
  return limits;
}

/// Takes an act as the server takes it from the process of LeRobot's front end: what that process made of a pickle must
/// be a sound request.
inline Observation served(const v1::Act& act) {
  v1::Request request;
  request.set_protocol_version(wire::kMaxVersion);
  *request.mutable_act() = act;
  const std::string bytes = request.SerializeAsString();
  wire::Envelope envelope;
  if (!wire::read_envelope(std::as_bytes(std::span(bytes)), envelope)) std::abort();
  auto decoded = serve::decode_act(envelope.body(std::as_bytes(std::span(bytes))), kMessageLimits,
                                   FeatureNames("view", {}, {}), FeatureNames("state", {}, {}));
  if (!decoded) return check_refusal(decoded.error()), Observation{};
  return decoded->observation;
}

/// Reads bytes as LeRobot's front end does, as a set-up and as an observation, up to what the engine gets. Returns
/// whether they were an act.
inline bool check_lerobot(std::span<const std::byte> bytes) {
  const Budget budget(5, 256);
  static const v1::Description policy = small_policy();
  static const serve::Names names =
      *serve::lerobot::lerobot_names({"", {"observation.images.front=wrist,bgr", "actions=0:2,degrees"}, {}}, policy);
  static const serve::lerobot::Setup known{
      {"arm.0", "arm.1", "hand"}, {{"image", &names.views[0]}, {"wrist", &names.views[1]}}, 2};
  const auto setup = serve::lerobot::read_setup(bytes, names, policy);
  if (!setup) check_refusal(setup.error());
  if (setup) {
    const auto again = serve::lerobot::setup_of(serve::lerobot::bytes_of(*setup), names);
    if (!again || !serve::lerobot::is_same(*setup, *again)) std::abort();
  }
  const auto message = pickle::Pickle::read(bytes);
  if (!message) return check_refusal(message.error()), false;
  const auto observed = serve::lerobot::read_observation(*message, known);
  if (!observed) return check_refusal(observed.error()), false;
  serve::lerobot::Filter filter;
  filter.computes(*observed);
  if (filter.takes(*observed) != observed->must_go) std::abort();
  const auto act = serve::lerobot::act_of(*message, *observed, known, names, small_limits());
  if (!act) return check_refusal(act.error()), false;
  v1::ActionChunk chunk;
  chunk.set_horizon(2), chunk.set_d_action(3);
  for (int i = 0; i < 6; ++i) chunk.add_actions(0.5f);
  if (!serve::lerobot::encode_actions(chunk, *observed, known, names, 0.1).ends_with('.')) std::abort();
  return check_observation(served(*act), kMessageLimits);
}

}  // namespace vla::fuzz
