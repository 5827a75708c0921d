// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vla/vla.h>

#include <doctest/doctest.h>

#include <memory>
#include <string>
#include <vector>

#include "support/editable_bundle.h"
#include "support/golden_case.h"

namespace vla::test {

struct Close {
  void operator()(vla_policy* policy) const { vla_policy_close(policy); }
  void operator()(vla_chunk* chunk) const { vla_chunk_close(chunk); }
};
using PolicyHandle = std::unique_ptr<vla_policy, Close>;
using ChunkHandle = std::unique_ptr<vla_chunk, Close>;

inline PolicyHandle open_policy(const std::string& bundle) {
  vla_options options = VLA_OPTIONS_INIT;
  options.n_thread = 1;
  vla_policy* policy = nullptr;
  REQUIRE_MESSAGE(vla_open(bundle.c_str(), &options, &policy) == VLA_OK, vla_last_error(nullptr)->message);
  return PolicyHandle(policy);
}

inline const std::string kTwoViews = golden_path("smolvla/two_views");

/// A golden case as a C caller has it; tests change one thing of `observation`, `states` or `views`.
struct Call {
  GoldenCase golden;
  std::vector<vla_view> views;
  std::vector<vla_state> states;
  vla_observation observation = VLA_OBSERVATION_INIT;

  explicit Call(const std::string& path = kTwoViews) : golden(GoldenCase::read(path)) {
    for (const auto& [view_name, frame] : golden.observation.views) {
      vla_view view = VLA_VIEW_INIT;
      view.name = view_name.c_str();
      view.kind = VLA_IMAGE_ABSENT;
      if (frame) {
        const auto& rgb = std::get<std::vector<std::uint8_t>>(frame->rgb);
        view.kind = VLA_IMAGE_RGB8;
        view.width = frame->width, view.height = frame->height;
        view.data = rgb.data(), view.size = rgb.size();
      }
      views.push_back(view);
    }
    for (const auto& [state_name, values] : golden.observation.states) {
      vla_state state = VLA_STATE_INIT;
      state.name = state_name.c_str();
      state.values = values.data(), state.n_value = values.size();
      states.push_back(state);
    }
    observation.views = views.data(), observation.n_view = views.size();
    observation.states = states.data(), observation.n_state = states.size();
    observation.text = golden.observation.text->data(), observation.text_size = golden.observation.text->size();
    observation.noise = golden.noise.data(), observation.n_noise = golden.noise.size();
  }
  Call(const Call&) = delete;

  void use_seed(std::uint64_t seed) {
    observation.noise = nullptr, observation.n_noise = 0;
    observation.has_seed = 1, observation.seed = seed;
  }
};

/// The actions of a call that must succeed.
inline std::vector<float> actions_of(vla_policy* policy, const vla_observation& observation) {
  vla_chunk* chunk = nullptr;
  REQUIRE_MESSAGE(vla_act(policy, &observation, &chunk) == VLA_OK, vla_last_error(policy)->message);
  const ChunkHandle handle(chunk);
  const float* actions = vla_chunk_actions(chunk);
  return {actions, actions + vla_chunk_horizon(chunk) * vla_chunk_d_action(chunk)};
}

}  // namespace vla::test
