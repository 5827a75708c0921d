// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdlib>
#include <span>

#include "fuzz/budget.h"
#include "serve/gr00t/codec.h"
#include "serve/openpi/codec.h"

namespace vla::fuzz {

/// A policy of two cameras, one state and two arrays of actions, as clients of other protocols meet it.
inline v1::Description small_policy() {
  v1::Description description;
  for (const char* view : {"observation.images.image", "observation.images.wrist"})
    description.add_views()->set_name(view);
  v1::StateSpec& state = *description.add_states();
  state.set_name("state.arm");
  for (const char* joint : {"arm.0", "arm.1", "hand"}) {
    state.add_dimensions()->set_name(joint);
    description.add_actions()->set_name(joint);
  }
  description.set_horizon(2);
  return description;
}

/// What is refused must be refused with a message of bounded length, and as a class that a client can cause.
inline void check_refusal(const Error& error) {
  if (error.message().size() > 8192) std::abort();
  if (error.code != Code::bad_request && error.code != Code::too_large && error.code != Code::bad_observation)
    std::abort();
  const std::string omni = serve::openpi::encode_omni_error(error);
  if (!msgpack::read(std::as_bytes(std::span(omni)))) std::abort();
  if (serve::openpi::encode_error(error).empty() || serve::gr00t::encode_error(error).empty()) std::abort();
}

/// What is accepted must keep every limit.
inline bool check_observation(const Observation& observation, const serve::ActLimits& limits) {
  std::int64_t pixels = 0;
  for (const auto& [name, frame] : observation.views) {
    if (frame && !check_frame(*frame, name, {limits.max_pixels})) std::abort();
    if (frame) pixels += std::int64_t{frame->width} * frame->height;
  }
  if (pixels > limits.max_pixels || observation.text.value_or("").size() > limits.max_text) std::abort();
  return true;
}

/// And be answered with a message that can be read.
inline bool check_act(const Observation& observation, const serve::ActLimits& limits, const std::string& answer) {
  if (!msgpack::read(std::as_bytes(std::span(answer)))) std::abort();
  return check_observation(observation, limits);
}

inline ActionChunk small_chunk() {
  ActionChunk chunk;
  chunk.horizon = 2, chunk.d_action = 3;
  chunk.actions.assign(6, 0.5f);
  return chunk;
}

inline constexpr serve::ActLimits kMessageLimits{
    .max_pixels = 1 << 12, .max_text = 100, .max_views = 4, .horizon = 2, .noise_rows = 2, .d_noise = 3, .d_action = 3};

/// Reads bytes as openpi's front end does. Whether they were an act.
inline bool check_openpi(std::span<const std::byte> bytes) {
  const Budget budget(5, 256);
  static const v1::Description policy = small_policy();
  static const serve::Names names = *serve::names_for(
      {"", {"observation/image=image", "observation/wrist_image=wrist,bgr", "observation/state=arm,degrees"}, {}},
      policy, "");
  const auto message = msgpack::read(bytes);
  if (!message) return check_refusal(message.error()), false;
  msgpack::Value omni = *message;
  if (const auto keys = serve::openpi::take_omni_keys(omni); !keys) check_refusal(keys.error());
  const auto act = serve::openpi::decode_act(*message, names, kMessageLimits, "");
  if (!act) return check_refusal(act.error()), false;
  return check_act(act->observation, kMessageLimits,
                   serve::openpi::encode_reply({*act, small_chunk(), 1.0}, names, 2.0));
}

/// The same for the front end of GR00T's clients.
inline bool check_gr00t(std::span<const std::byte> bytes) {
  const Budget budget(5, 256);
  static const v1::Description policy = small_policy();
  static const serve::Names names = *serve::own_names({}, policy, "");
  const auto message = msgpack::read(bytes);
  if (!message) return check_refusal(message.error()), false;
  const auto observed = serve::gr00t::read_observation(message->find("data"));
  if (!observed) return check_refusal(observed.error()), false;
  const auto observation = serve::observe(observed->flat, names, kMessageLimits);
  if (!observation) return check_refusal(observation.error()), false;
  const serve::ActRequest request{*observation, std::uint64_t{0}, 0, {}, 0};
  const std::string answer =
      serve::gr00t::encode_reply({request, small_chunk(), 1.0}, observed->dialect, names, policy);
  return check_act(*observation, kMessageLimits, answer);
}

}  // namespace vla::fuzz
