// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "capi/description.h"

namespace vla::capi {
namespace {

std::size_t size_of(int count) { return static_cast<std::size_t>(count); }

/// `count` of the names or units that follow each other for all states.
std::vector<std::string> part(const std::vector<std::string>& all, std::size_t from, std::size_t count) {
  const auto begin = all.begin() + static_cast<std::ptrdiff_t>(from);
  return {begin, begin + static_cast<std::ptrdiff_t>(count)};
}

}  // namespace

Description::Texts::Texts(std::vector<std::string> given) : strings(std::move(given)) {
  for (const std::string& text : strings) pointers.push_back(text.c_str());
}

const char* Description::keep(std::string text) { return kept_.emplace_back(std::move(text)).c_str(); }

void Description::add_views(const Engine& engine) {
  const Keys& keys = engine.bundle().keys();
  const auto names = *keys.strings("observation.views"), aliases = *keys.strings("observation.view_aliases");
  const auto optional = *keys.integers("observation.view_optional", kFlag);
  const Recipe& recipe = engine.processor().recipe();
  for (std::size_t i = 0; i < names.size(); ++i)
    view_infos_.push_back(
        {sizeof(vla_view_info), keep(names[i]), keep(aliases[i]), optional[i], recipe.width, recipe.height});
  for (const vla_view_info& info : view_infos_) views_.push_back(&info);
}

void Description::add_states(const Engine& engine) {
  const Keys& keys = engine.bundle().keys();
  const auto names = *keys.strings("observation.state_names"), units = *keys.strings("observation.state_units");
  const std::vector<std::string>& states = engine.processor().states().names();
  std::size_t from = 0;
  for (std::size_t i = 0; i < states.size(); ++i) {
    const std::size_t width = size_of(engine.processor().state_dims()[i]);
    state_names_.emplace_back(part(names, from, width));
    state_units_.emplace_back(part(units, from, width));
    state_infos_.push_back({sizeof(vla_state_info), keep(states[i]), width, state_names_.back().pointers.data(),
                            state_units_.back().pointers.data()});
    from += width;
  }
  for (const vla_state_info& info : state_infos_) states_.push_back(&info);
}

/// A bundle that was loaded has every key that is read here.
Description::Description(const Engine& engine)
    : action_names_(engine.processor().action_names()), action_units_(*engine.bundle().keys().strings("action.units")) {
  add_views(engine);
  add_states(engine);
  const Keys& keys = engine.bundle().keys();
  const auto text = [&](const char* key) { return keep(*keys.string(key)); };
  const MemoryUse memory = engine.memory();
  vla_description& d = description_;
  d.struct_size = sizeof d;
  d.n_view = views_.size(), d.views = views_.data();
  d.min_views = size_of(engine.processor().min_views());
  d.n_state = states_.size(), d.states = states_.data();
  d.max_text_tokens = size_of(engine.processor().recipe().max_tokens);
  d.horizon = size_of(engine.n_row());
  d.d_action = action_names_.strings.size();
  d.action_names = action_names_.pointers.data(), d.action_units = action_units_.pointers.data();
  d.rate_hz = *keys.number("action.rate_hz", kRateHz);
  d.d_noise = size_of(engine.d_action());
  d.noise = keep(engine.solver().noise);
  d.bundle_path = keep(engine.bundle().path());
  d.arch = text("vla.arch"), d.checksum = text("vla.checksum"), d.dtype = text("vla.dtype");
  d.source = text("vla.source.name"), d.revision = text("vla.source.revision");
  d.converter = text("vla.source.converter");
  d.precision = keep(engine.precision());
  d.kernels = keep(engine.kernels());
  d.device = keep(engine.device().name());
  d.noise_rows = size_of(engine.horizon());
  d.memory_weights = memory.weights, d.memory_plan = memory.plan, d.memory_working = memory.working;
}

}  // namespace vla::capi
