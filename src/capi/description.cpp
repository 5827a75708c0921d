// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "capi/description.h"

namespace vla::capi {

const char* const* Description::keep_names(const std::vector<vla::Description::Number>& numbers) {
  Texts& texts = texts_.emplace_back();
  for (const auto& number : numbers) texts.push_back(keep(number.name));
  return texts.data();
}

const char* const* Description::keep_units(const std::vector<vla::Description::Number>& numbers) {
  Texts& texts = texts_.emplace_back();
  for (const auto& number : numbers) texts.push_back(keep(number.unit));
  return texts.data();
}

Description::Description(const std::vector<vla::Description>& robots) {
  fill_common(robots.front());
  if (robots.size() == 1) {
    fill_robot(robots.front());
    return;
  }
  for (const vla::Description& robot : robots) {
    robots_.emplace_back(new Description(robot));
    robot_pointers_.push_back(robots_.back()->get());
  }
  vla_description& d = description_;
  d.noise = d.real_time_chunking = d.embodiment = "";
  d.n_embodiment = robots_.size(), d.embodiments = robot_pointers_.data();
}

void Description::fill_common(const vla::Description& from) {
  vla_description& d = description_;
  d.struct_size = sizeof d;
  d.bundle_path = keep(from.path), d.arch = keep(from.arch), d.checksum = keep(from.checksum);
  d.source = keep(from.source), d.revision = keep(from.revision), d.converter = keep(from.converter);
  d.dtype = keep(from.dtype), d.precision = keep(from.precision), d.kernels = keep(from.kernels);
  d.device = keep(from.device);
  d.memory_weights = from.memory.weights, d.memory_plan = from.memory.plan, d.memory_working = from.memory.working;
}

void Description::fill_robot(const vla::Description& from) {
  for (const auto& view : from.views)
    view_infos_.push_back(
        {sizeof(vla_view_info), keep(view.name), keep(view.alias), view.optional, view.width, view.height});
  for (const auto& state : from.states)
    state_infos_.push_back({sizeof(vla_state_info), keep(state.name), state.numbers.size(), keep_names(state.numbers),
                            keep_units(state.numbers)});
  for (const vla_view_info& info : view_infos_) views_.push_back(&info);
  for (const vla_state_info& info : state_infos_) states_.push_back(&info);

  const auto size_of = [](int count) { return static_cast<std::size_t>(count); };
  vla_description& d = description_;
  d.n_view = views_.size(), d.views = views_.data();
  d.min_views = size_of(from.min_views);
  d.n_state = states_.size(), d.states = states_.data();
  d.max_text_tokens = size_of(from.max_text_tokens);
  d.horizon = size_of(from.horizon), d.d_action = from.actions.size();
  d.action_names = keep_names(from.actions), d.action_units = keep_units(from.actions);
  d.rate_hz = from.rate_hz, d.n_action_steps = size_of(from.n_action_steps);
  d.noise_rows = size_of(from.noise_rows), d.d_noise = size_of(from.d_action_padded);
  d.noise = keep(from.noise), d.real_time_chunking = keep(from.real_time_chunking);
  d.embodiment = keep(from.embodiment);
}

}  // namespace vla::capi
