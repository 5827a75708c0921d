// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/warm_up.h"

#include <fmt/format.h>

#include "base/clock.h"
#include "processor/ops/op.h"

namespace vla::serve {
namespace {

/// Number of observations to try: a synthetic state may be invalid for the robot, as zeros are no rotation.
constexpr std::uint64_t kTries = 3;

/// Returns a text of as many words as the prompt accepts: fewer than its tokens if the prompt's own tokens must not be
/// cut off.
std::string longest_text(const Processor& processor, Observation observation) {
  Inputs inputs;
  for (int n_word = processor.recipe().max_tokens; n_word > 0; n_word = n_word * 3 / 4) {
    std::string& text = observation.text.emplace();
    for (int i = 0; i < n_word; ++i) text += "go ";
    if (processor.encode_state(observation, inputs) && processor.encode_text(observation, inputs)) return text;
  }
  return {};
}

/// The middle of a state's training data, from the normalization statistics; zeros if the bundle has none.
std::vector<float> middle_of(const Robot& robot, const std::string& state, std::size_t width) {
  const auto stats = [&](const char* name) { return robot.bundle().stats(fmt::format("stats.{}.{}", state, name)); };
  std::vector<float> middle(width);
  const auto fill = [&](const std::vector<double>& a, const std::vector<double>& b) {
    if (a.size() != width || b.size() != width) return false;
    for (std::size_t i = 0; i < width; ++i) middle[i] = static_cast<float>((a[i] + b[i]) / 2);
    return true;
  };
  for (const auto& [low, high] : {std::pair{"mean", "mean"}, std::pair{"min", "max"}, std::pair{"q01", "q99"}})
    if (const auto a = stats(low), b = stats(high); a && b && fill(*a, *b)) break;
  return middle;
}

/// The state of try `number`: the middle, then random places around it.
std::vector<float> state_of(const Robot& robot, const std::string& state, std::size_t width, std::uint64_t number) {
  std::vector<float> values = middle_of(robot, state, width);
  if (number == 0) return values;
  const auto away = draw_noise("uniform", number, width);
  for (std::size_t i = 0; away && i < width; ++i) values[i] += (*away)[i];
  return values;
}

/// An observation of a robot with every view that it has and the longest text.
Observation largest_observation(const Robot& robot, std::uint64_t number) {
  const Processor& processor = robot.processor();
  const Recipe& recipe = processor.recipe();
  Observation observation;
  for (std::size_t i = 0; i < processor.views().names().size(); ++i) {
    if (processor.is_absent(i)) continue;
    const auto [width, height] =
        recipe.fit->camera_size(static_cast<int>(i)).value_or(CameraSize{recipe.width, recipe.height});
    std::vector<std::uint8_t> grey(static_cast<std::size_t>(width) * static_cast<std::size_t>(height) * 3, 128);
    observation.views.emplace(processor.views().names()[i], Frame{width, height, std::move(grey)});
  }
  for (std::size_t i = 0; i < processor.states().names().size(); ++i)
    observation.states.emplace(
        processor.states().names()[i],
        state_of(robot, processor.states().names()[i], static_cast<std::size_t>(processor.state_dims()[i]), number));
  observation.text = longest_text(processor, observation);
  observation.embodiment = robot.bundle().embodiment();
  return observation;
}

/// Computes an act. A policy that decodes tokens computes only the first token, since it may answer grey frames with a
/// text.
Status act(Engine& engine, const Robot& robot, const Observation& observation, std::uint64_t seed) {
  EncodedObservation encoded;  // not kept: every served act has its own memory
  VLA_CHECK(engine.encode(observation, Noise(seed), {}, encoded));
  if (robot.solver().decodes) return engine.warm_up({observation.embodiment, robot.shape_of(encoded)});
  VLA_CHECK(engine.send_ahead(encoded));
  const auto chunk = engine.compute(encoded);
  return chunk ? Status() : chunk.error();
}

/// The refusal of a policy. It names the first tap of the network with values that are not finite.
Error not_finite(Engine& engine, const Observation& observation, std::uint64_t seed) {
  const Result<std::string> tap = engine.find_not_finite(observation, Noise(seed));
  return {Code::bad_action, "warm-up", "finite actions",
          tap && !tap->empty() ? fmt::format("numbers that are not, of the network first at the tap {}", *tap)
                               : std::string("numbers that are not, made of those of the network"),
          "the weights are damaged, or overflow in this precision: vla run --tap shows the values"};
}

Status warm_up(Engine& engine, const Robot& robot) {
  Error refused;
  bool is_finite = true;
  std::uint64_t last = 0;
  for (std::uint64_t number = 0; number < kTries; ++number) {
    const Status answered = act(engine, robot, largest_observation(robot, number), number);
    if (answered) return {};
    refused = answered.error();
    if (refused.code == Code::bad_action) is_finite = false, last = number;
    if (refused.code == Code::bad_action || refused.code == Code::bad_observation) continue;
    is_finite = true;
    break;
  }
  if (!is_finite) refused = not_finite(engine, largest_observation(robot, last), last);
  const std::string& tag = robot.bundle().embodiment();
  refused.where = fmt::format("{}{}: {}", robot.bundle().path(), tag.empty() ? "" : " of " + tag, refused.where);
  return refused;
}

}  // namespace

Result<double> warm_up(Engine& engine, const std::vector<ActShape>& sizes) {
  const auto start = Clock::now();
  for (const Robot* robot : engine.robots()) VLA_CHECK(warm_up(engine, *robot));
  for (const ActShape& size : sizes)
    if (const Status done = engine.warm_up(size); !done && done.error().code != Code::bad_observation)
      return done.error();
  return std::chrono::duration<double, std::milli>(Clock::now() - start).count();
}

}  // namespace vla::serve
