// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "fuzz/message_target.h"
#include "serve/lerobot/codec.h"

namespace vla::fuzz {

/// Reads bytes as LeRobot's front end does, as a set-up and as an observation. Whether they were an act.
inline bool check_lerobot(std::span<const std::byte> bytes) {
  const Budget budget(5, 256);
  static const v1::Description policy = small_policy();
  static const serve::Names names =
      *serve::lerobot::lerobot_names({"observation.images.front=wrist,bgr", "actions=0:2,degrees"}, policy);
  static const serve::lerobot::Setup known{
      {"arm.0", "arm.1", "hand"}, {{"image", &names.views[0]}, {"wrist", &names.views[1]}}, 2};
  const auto setup = serve::lerobot::read_setup(bytes, names, policy);
  if (!setup) check_refusal(setup.error());
  const auto observed =
      serve::lerobot::read_observation({reinterpret_cast<const char*>(bytes.data()), bytes.size()}, known);
  if (!observed) return check_refusal(observed.error()), false;
  serve::lerobot::Filter filter;
  filter.computes(**observed);
  if (filter.takes(**observed) != (*observed)->must_go) std::abort();
  const auto act = serve::lerobot::decode_act(**observed, known, names, kMessageLimits, "");
  if (!act) return check_refusal(act.error()), false;
  const std::string answer = serve::lerobot::encode_actions({*act, small_chunk(), 1.0}, **observed, known, names, 0.1);
  if (!answer.ends_with('.')) std::abort();
  return check_observation(act->observation, kMessageLimits);
}

}  // namespace vla::fuzz
