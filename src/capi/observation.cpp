// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "capi/observation.h"

#include "capi/structs.h"

namespace vla::capi {
namespace {

constexpr std::size_t kMaxFile = std::size_t{1} << 30, kMaxLeftover = std::size_t{1} << 24;

std::span<const std::byte> bytes_of(const vla_view& view) {
  return {static_cast<const std::byte*>(view.data), view.size};
}

/// Copies rows, with or without padding between them, to (height, width, 3).
Result<Frame> read_rows(const vla_view& view, const std::string& where) {
  if (view.width < 1 || view.height < 1 || std::int64_t{view.width} * view.height > ImageLimits{}.max_pixels)
    return Error{Code::bad_observation, where, fmt::format("1 to {} pixels", ImageLimits{}.max_pixels),
                 fmt::format("{} x {}", view.width, view.height)};
  const auto row = static_cast<std::size_t>(view.width) * 3, n_row = static_cast<std::size_t>(view.height);
  const std::size_t stride = view.stride == 0 ? row : view.stride;
  if (stride < row || stride > kMaxFile)
    return Error{Code::bad_observation, where + ".stride", fmt::format("{} to {} bytes", row, kMaxFile),
                 std::to_string(stride)};
  const std::size_t min_size = stride * (n_row - 1) + row;
  if (view.size != min_size && view.size != stride * n_row)
    return Error{Code::bad_observation, where + ".size", fmt::format("{} bytes", stride * n_row),
                 std::to_string(view.size)};
  const auto* from = static_cast<const std::uint8_t*>(view.data);
  std::vector<std::uint8_t> rgb;
  rgb.reserve(row * n_row);
  for (std::size_t i = 0; i < n_row; ++i) rgb.insert(rgb.end(), from + i * stride, from + i * stride + row);
  return Frame{view.width, view.height, std::move(rgb)};
}

Result<std::optional<Frame>> read_view(const vla_view& view, const std::string& where) {
  if (view.kind == VLA_IMAGE_ABSENT) {
    if (view.data != nullptr || view.size != 0) return usage(where, "no data for an absent view", "some");
    return std::optional<Frame>();
  }
  if (view.kind != VLA_IMAGE_RGB8 && view.kind != VLA_IMAGE_FILE)
    return usage(where + ".kind", "VLA_IMAGE_ABSENT, VLA_IMAGE_RGB8 or VLA_IMAGE_FILE", std::to_string(view.kind));
  if (view.data == nullptr) return usage(where + ".data", "pixels or a file", "NULL", "declare it VLA_IMAGE_ABSENT");
  if (view.kind == VLA_IMAGE_RGB8) {
    VLA_TRY(Frame frame, read_rows(view, where));
    return std::optional<Frame>(std::move(frame));
  }
  if (view.width != 0 || view.height != 0 || view.stride != 0)
    return usage(where, "width, height and stride 0 for a file, which says its size itself", "others");
  if (view.size > kMaxFile)
    return Error{Code::bad_observation, where, fmt::format("at most {} bytes", kMaxFile), std::to_string(view.size)};
  VLA_TRY(Frame frame, decode_image(bytes_of(view), where));
  return std::optional<Frame>(std::move(frame));
}

Status read_views(const vla_observation& given, const FeatureNames& features, Observation& observation) {
  VLA_TRY(const std::vector<vla_view> views, read_structs(given.views, given.n_view, "observation.views"));
  for (std::size_t i = 0; i < views.size(); ++i) {
    VLA_TRY(const std::string name, read_name(views[i].name, fmt::format("observation.views[{}].name", i)));
    VLA_TRY(std::optional<Frame> frame, read_view(views[i], features.place(name)));
    if (!observation.views.emplace(name, std::move(frame)).second)
      return Error{Code::bad_observation, features.place(name), "each view once", "a second one"};
  }
  return {};
}

/// A state without a name is the policy's only state.
Result<std::string> state_name(const vla_state& state, const FeatureNames& features, const std::string& where) {
  if (state.name != nullptr) return read_name(state.name, where);
  if (features.names().size() == 1) return features.names().front();
  return Error{Code::bad_observation, where, "one of " + features.listed(), "NULL"};
}

Status read_states(const vla_observation& given, const FeatureNames& features, Observation& observation) {
  VLA_TRY(const std::vector<vla_state> states, read_structs(given.states, given.n_state, "observation.states"));
  for (std::size_t i = 0; i < states.size(); ++i) {
    const vla_state& state = states[i];
    const std::string where = fmt::format("observation.states[{}]", i);
    VLA_TRY(const std::string name, state_name(state, features, where + ".name"));
    if (state.n_value > kMaxVector)
      return Error{Code::bad_observation, features.place(name), fmt::format("at most {} numbers", kMaxVector),
                   std::to_string(state.n_value)};
    if (state.values == nullptr) return usage(where + ".values", "numbers", "NULL");
    if (!observation.states.emplace(name, std::vector<float>(state.values, state.values + state.n_value)).second)
      return Error{Code::bad_observation, features.place(name), "each state once", "a second one"};
  }
  return {};
}

/// There is no default: a chunk from noise that nobody chose cannot be reproduced.
Result<Noise> read_noise(const vla_observation& given, const Robot& robot) {
  if (given.has_seed > 1) return usage("observation.has_seed", "0 or 1", std::to_string(given.has_seed));
  const bool has_noise = given.noise != nullptr;
  if (has_noise == (given.has_seed == 1))
    return usage("observation", "noise or seed", has_noise ? "both" : "neither", "set noise, or has_seed and seed");
  if (!has_noise) {
    if (given.n_noise != 0) return usage("observation.noise", fmt::format("{} numbers", given.n_noise), "NULL");
    return Noise(given.seed);
  }
  const auto n_row = static_cast<std::size_t>(robot.noise_rows()),
             width = static_cast<std::size_t>(robot.d_action_padded());
  if (given.n_noise != n_row * width)
    return Error{Code::bad_observation, "noise", fmt::format("{} x {} numbers", n_row, width),
                 fmt::format("{} numbers", given.n_noise)};
  return Noise(std::vector<float>(given.noise, given.noise + given.n_noise));
}

/// Checks only that the leftover is given consistently; the engine checks its values.
Result<std::optional<Leftover>> read_leftover(const vla_observation& given) {
  if (given.leftover == nullptr) {
    if (given.n_leftover == 0 && given.leftover_delay == 0 && given.schedule == nullptr && given.max_guidance == 0)
      return std::optional<Leftover>();
    return usage("observation.leftover", "rows for what is said of them", "NULL");
  }
  if (given.n_leftover > kMaxLeftover)
    return usage("observation.n_leftover", fmt::format("at most {}", kMaxLeftover), std::to_string(given.n_leftover));
  Leftover leftover{{given.leftover, given.leftover + given.n_leftover}, given.leftover_delay, {}, {}};
  if (given.schedule != nullptr) {
    VLA_TRY(leftover.schedule, read_name(given.schedule, "observation.schedule"));
  }
  if (given.max_guidance != 0) leftover.max_guidance = given.max_guidance;
  return std::optional<Leftover>(std::move(leftover));
}

}  // namespace

Result<Request> read_observation(const vla_observation* given, const Engine& engine) {
  VLA_TRY(const vla_observation known, read_struct<vla_observation>(given, "observation"));
  Request request;
  if (known.embodiment != nullptr) {
    VLA_TRY(request.observation.embodiment, read_name(known.embodiment, "observation.embodiment"));
  }
  VLA_TRY(const Robot* robot, engine.robot(request.observation.embodiment));
  VLA_TRY(request.noise, read_noise(known, *robot));
  VLA_TRY(request.leftover, read_leftover(known));
  if (known.text_size > Tokenizer::kMaxText)
    return Error{Code::bad_observation, "instruction", fmt::format("at most {} bytes", Tokenizer::kMaxText),
                 std::to_string(known.text_size)};
  if (known.text == nullptr && known.text_size > 0) return usage("observation.text", "a text", "NULL");
  if (known.text != nullptr) request.observation.text.emplace(known.text, known.text_size);
  VLA_CHECK(read_states(known, robot->processor().states(), request.observation));
  VLA_CHECK(read_views(known, robot->processor().views(), request.observation));
  return request;
}

}  // namespace vla::capi
