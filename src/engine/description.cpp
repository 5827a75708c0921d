// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "engine/description.h"

#include <fmt/format.h>

#include "bundle/run_keys.h"

namespace vla {
namespace {

std::vector<Description::Number> numbers(const std::vector<std::string>& names, const std::vector<std::string>& units,
                                         std::size_t first, std::size_t count) {
  std::vector<Description::Number> out;
  for (std::size_t i = first; i < first + count; ++i) out.push_back({names[i], units[i]});
  return out;
}

}  // namespace

/// Reads keys that Processor::create and Robot::open have checked.
Description describe(const Engine& engine, const Robot& robot) {
  const Keys& keys = robot.bundle().keys();
  const Processor& processor = robot.processor();
  const auto texts = [&](const char* key) { return *keys.strings(key); };
  Description out;

  const auto aliases = texts("observation.view_aliases");
  const Recipe& recipe = processor.recipe();
  const std::vector<int> cameras =
      keys.has(kCameraSizes) ? *keys.integers(kCameraSizes, kCameraSide) : std::vector<int>(2 * aliases.size());
  for (std::size_t i = 0; i < aliases.size(); ++i)
    out.views.push_back({.name = processor.views().names()[i],
                         .alias = aliases[i],
                         .optional = processor.is_optional(i),
                         .width = recipe.width,
                         .height = recipe.height,
                         .camera_width = cameras[2 * i],
                         .camera_height = cameras[2 * i + 1]});
  out.min_views = processor.min_views();

  const auto names = texts("observation.state_names"), units = texts("observation.state_units");
  std::size_t first = 0;
  for (std::size_t i = 0; i < processor.states().names().size(); ++i) {
    const auto width = static_cast<std::size_t>(processor.state_dims()[i]);
    out.states.push_back({processor.states().names()[i], numbers(names, units, first, width)});
    first += width;
  }
  out.max_text_tokens = recipe.max_tokens;

  out.horizon = robot.horizon();
  out.actions = numbers(processor.action_names(), texts("action.units"), 0, processor.action_names().size());
  out.rate_hz = *keys.number("action.rate_hz", kRateHz);
  out.n_action_steps = keys.has(kActionSteps) ? *keys.integer(kActionSteps, {1, kMaxVector}) : 0;
  out.rtc = {};
  if (keys.has(kRtcHorizon))
    out.rtc = {*keys.integer(kRtcHorizon, {1, kMaxVector}), *keys.string(kRtcSchedule),
               *keys.number(kRtcGuidance, {0, 1e9})};
  out.noise_rows = robot.noise_rows();
  out.d_action_padded = robot.d_action_padded();
  out.solver = *keys.string("solver.kind");
  out.noise = robot.solver().noise;
  out.n_step = robot.solver().n_step;
  out.t_start = robot.solver().times.front().value;
  out.real_time_chunking = kind_name(robot.real_time_chunking().kind);

  out.embodiment = robot.bundle().embodiment();
  out.path = robot.bundle().path();
  for (const auto& [key, text] : {std::pair{"arch", &out.arch},
                                  {"dtype", &out.dtype},
                                  {"checksum", &out.checksum},
                                  {"source.name", &out.source},
                                  {"source.revision", &out.revision},
                                  {"source.converter", &out.converter}})
    *text = *keys.string(fmt::format("vla.{}", key));
  out.precision = precision_name(engine.precision());
  out.kernels = engine.kernels();
  out.device = engine.device().name();
  out.memory = engine.memory();
  return out;
}

}  // namespace vla
