// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Source: lerobot 0.6.1, async_inference/policy_server.py and helpers.py.
#include "serve/lerobot/codec.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <cmath>
#include <set>
#include <utility>

#include "base/printable.h"
#include "serve/lerobot/setup.pb.h"

namespace vla::serve::lerobot {

using pickle::Value;
using Type = Value::Type;

namespace {

constexpr const char* kState = "observation.state";
constexpr std::string_view kImages = "observation.images.";
constexpr std::int64_t kMaxTimestep = std::int64_t{1} << 53;
constexpr std::size_t kMaxComputed = 4096;  // timesteps remembered per robot

Error bad(Code code, std::string where, std::string expected, std::string found) {
  return {code, std::move(where), std::move(expected), std::move(found)};
}

Result<const Value*> attribute(const Value& object, const char* key, Type type) {
  const Value* const value = object.find(key);
  if (value == nullptr || value->type != type)
    return bad(Code::bad_request, key, "an attribute of LeRobot's class", value == nullptr ? "none" : "another type");
  return value;
}

Status check_class(const Value& object, const char* name) {
  if (object.type == Type::object && object.name.ends_with(std::string(".") + name)) return {};
  return bad(Code::bad_request, "pickle", name,
             object.type == Type::object ? std::string(object.name) : "another value");
}

std::string text_of(const Value& value) { return printable(std::string(value.data.substr(0, 200))); }

Result<std::vector<std::string>> motors_of(const Value* feature) {
  const Value* const names = feature == nullptr ? nullptr : feature->find("names");
  if (names == nullptr || names->type != Type::list)
    return bad(Code::bad_observation, kState, "the state's names in lerobot_features", "none");
  std::vector<std::string> motors;
  for (const Value* name : names->items) {
    if (name->type != Type::text) return bad(Code::bad_observation, kState, "names that are text", "another value");
    motors.emplace_back(name->data);
  }
  return motors;
}

const Names::Entry* view_of(const Names& names, std::string_view key) {
  const auto found = std::find_if(names.views.begin(), names.views.end(), [&](const auto& e) { return e.key == key; });
  return found == names.views.end() ? nullptr : &*found;
}

/// The name of the state's dimension i if the checkpoint gives none.
std::string placeholder(const v1::StateSpec& state, std::size_t i) {
  return fmt::format("{}.{}", state.name().substr(state.name().rfind('.') + 1), i);
}

/// Compares the motors with the state's dimensions, by name where the bundle has names: a reading of another joint must
/// not pass silently.
Status check_motors(const std::vector<std::string>& motors, const v1::StateSpec& state, bool is_in_order) {
  const auto told = [](const std::vector<std::string>& names) {
    return fmt::format("{}: {}", names.size(), printable(fmt::format("{}", fmt::join(names, ", "))).substr(0, 1000));
  };
  std::vector<std::string> own;
  for (const v1::Dimension& dimension : state.dimensions()) own.push_back(dimension.name());
  if (motors.size() != own.size())
    return bad(Code::bad_observation, kState, fmt::format("{} values of the policy's state", own.size()), told(motors));
  for (std::size_t i = 0; i < own.size() && !is_in_order; ++i)
    if (!own[i].empty() && own[i] != placeholder(state, i) && own[i] != motors[i])
      return Error{Code::bad_observation, kState, "the policy's " + told(own), told(motors),
                   fmt::format("where these are the same joints in the same order, say so at the server: --map {}={},"
                               "in_order",
                               kState, state.name())};
  return {};
}

}  // namespace

Result<Names> lerobot_names(Given given, const v1::Description& description) {
  if (description.states_size() != 1)
    return Error{Code::usage, "--lerobot", "a policy with one state", fmt::format("{}", description.states_size())};
  const std::vector<std::string> lines = std::exchange(given.lines, {});
  std::vector<std::string>& all = given.lines;
  std::set<std::string> absent;
  for (const std::string& view : given.absent) absent.insert(view_named(view, description));
  const auto is_mapped = [&](const std::string& feature) {
    return std::any_of(all.begin(), all.end(), [&](const std::string& line) {
      const std::string words = line.substr(line.find('=') + 1);
      const std::string name = words.substr(0, words.find(','));
      return name == feature || feature.ends_with("." + name);
    });
  };
  for (const std::string& line : lines)
    if (line.starts_with("observation.") || line.starts_with("actions=")) all.push_back(line);
  for (const v1::ViewSpec& view : description.views())
    if (!is_mapped(view.name()) && !absent.contains(view.name())) all.push_back(view.name() + "=" + view.name());
  const std::string& state = description.states(0).name();
  if (!is_mapped(state)) all.push_back(std::string(kState) + "=" + state);
  return names_for(given, description, "--lerobot");
}

Result<Setup> read_setup(std::span<const std::byte> message, const Names& names, const v1::Description& description) {
  VLA_TRY(const pickle::Pickle read, pickle::Pickle::read(message));
  VLA_CHECK(check_class(read.root(), "RemotePolicyConfig"));
  VLA_TRY(const Value* features, attribute(read.root(), "lerobot_features", Type::map));
  VLA_TRY(const Value* n_action, attribute(read.root(), "actions_per_chunk", Type::integer));
  Setup setup;
  setup.n_action = n_action->integer;
  if (setup.n_action < 1)
    return bad(Code::bad_observation, "actions_per_chunk", "1 or more", std::to_string(setup.n_action));
  VLA_TRY(setup.motors, motors_of(features->find(kState)));
  VLA_CHECK(check_motors(setup.motors, description.states(0), names.states.front().convention.is_in_order));
  std::vector<std::string> wanted, unknown;
  for (const Names::Entry& entry : names.views) wanted.push_back(entry.key);
  for (std::size_t i = 0; i + 1 < features->items.size(); i += 2) {
    const Value& key = *features->items[i];
    if (key.type != Type::text || !key.data.starts_with(kImages)) continue;
    const Names::Entry* const entry = view_of(names, key.data);
    const bool is_ignored =
        std::any_of(names.ignored.begin(), names.ignored.end(), [&](const auto& e) { return e.key == key.data; });
    if (entry == nullptr) {
      if (!is_ignored) unknown.push_back(text_of(key));
      continue;
    }
    setup.cameras.push_back({std::string(key.data.substr(kImages.size())), entry});
  }
  if (!unknown.empty() || (setup.cameras.empty() && !names.views.empty()))
    return Error{Code::bad_observation, "lerobot_features", fmt::format("cameras of {}", fmt::join(wanted, ", ")),
                 unknown.empty() ? std::string("none") : fmt::format("{}", fmt::join(unknown, ", ")).substr(0, 1000),
                 "name the robot's cameras so, or map them at the server: --map KEY=VIEW"};
  for (const v1::ViewSpec& view : description.views()) {
    const auto is_it = [&](const Setup::Camera& camera) { return camera.entry->feature == view.name(); };
    if (!view.optional() && std::none_of(setup.cameras.begin(), setup.cameras.end(), is_it))
      return Error{Code::bad_observation, "lerobot_features", "a camera for " + view.name(), "none",
                   "map one at the server: --map KEY=VIEW; or say there that the robot has none: --absent VIEW"};
  }
  return setup;
}

std::string bytes_of(const Setup& setup) {
  setup::Setup out;
  out.set_n_action(setup.n_action);
  for (const std::string& motor : setup.motors) out.add_motors(motor);
  for (const Setup::Camera& camera : setup.cameras) out.add_cameras(camera.key);
  return out.SerializeAsString();
}

Result<Setup> setup_of(std::string_view bytes, const Names& names) {
  setup::Setup in;
  if (!in.ParseFromArray(bytes.data(), static_cast<int>(bytes.size())))
    return bad(Code::bad_request, "setup", "one that was kept", "other bytes");
  Setup setup;
  setup.n_action = in.n_action();
  setup.motors.assign(in.motors().begin(), in.motors().end());
  for (const std::string& key : in.cameras()) {
    const Names::Entry* const entry = view_of(names, std::string(kImages) + key);
    if (entry == nullptr) return bad(Code::bad_request, "setup", "cameras of the policy", "another");
    setup.cameras.push_back({key, entry});
  }
  return setup;
}

bool is_same(const Setup& a, const Setup& b) { return bytes_of(a) == bytes_of(b); }

Result<Observed> read_observation(const pickle::Pickle& message, const Setup& setup) {
  const Value& root = message.root();
  VLA_CHECK(check_class(root, "TimedObservation"));
  VLA_TRY(const Value* timestep, attribute(root, "timestep", Type::integer));
  VLA_TRY(const Value* timestamp, attribute(root, "timestamp", Type::real));
  VLA_TRY(const Value* must_go, attribute(root, "must_go", Type::boolean));
  VLA_TRY(const Value* values, attribute(root, "observation", Type::map));
  Observed observed;
  observed.timestep = timestep->integer;
  observed.timestamp = timestamp->real;
  observed.must_go = must_go->integer != 0;
  observed.module = root.name.substr(0, root.name.rfind('.'));
  if (observed.timestep < 0 || observed.timestep > kMaxTimestep)
    return bad(Code::bad_observation, "timestep", fmt::format("0 to {}", kMaxTimestep),
               std::to_string(observed.timestep));
  if (!std::isfinite(observed.timestamp)) return bad(Code::bad_observation, "timestamp", "seconds", "not finite");
  for (const std::string& motor : setup.motors) {
    const Value* const reading = values->find(motor);
    if (reading == nullptr || !reading->is_number())
      return bad(Code::bad_observation, printable(motor.substr(0, 200)), "a number",
                 reading == nullptr ? "none" : "another value");
    observed.state.push_back(static_cast<float>(reading->real));
  }
  return observed;
}

Result<v1::Act> act_of(const pickle::Pickle& message, const Observed& observed, const Setup& setup, const Names& names,
                       const v1::Limits& limits) {
  const Value& values = *message.root().find("observation");
  v1::Act act;
  const ImageLimits pixels{static_cast<std::int64_t>(limits.max_pixels()), Code::too_large};
  for (const Setup::Camera& camera : setup.cameras) {
    const std::string where = printable(camera.key.substr(0, 200));
    const Value* const value = values.find(camera.key);
    if (value == nullptr || value->type != Type::array)
      return bad(Code::bad_observation, where, "an array of pixels", value == nullptr ? "none" : "another value");
    VLA_TRY(const Frame frame, frame_of(*value->array, where, pixels, camera.entry->convention.is_bgr));
    v1::View& view = *act.add_views();
    view.set_name(camera.entry->feature);
    view.mutable_rgb()->set_width(static_cast<std::uint32_t>(frame.width));
    view.mutable_rgb()->set_height(static_cast<std::uint32_t>(frame.height));
    const auto& rows = std::get<std::vector<std::uint8_t>>(frame.rgb);
    view.mutable_rgb()->set_rows(rows.data(), rows.size());
  }
  const Names::Entry& entry = names.states.front();
  v1::State& state = *act.add_states();
  state.set_name(entry.feature);
  for (const float x : observed.state) state.add_values(entry.convention.to_policy(x));
  const Value* const task = values.find("task");
  if (task == nullptr || task->type != Type::text) return bad(Code::bad_observation, "task", "an instruction", "none");
  if (task->data.size() > limits.max_text_bytes())
    return bad(Code::too_large, "task", fmt::format("at most {} bytes", limits.max_text_bytes()),
               fmt::format("{} bytes", task->data.size()));
  for (const std::string& name : names.absent) {
    v1::View& view = *act.add_views();
    view.set_name(name);
    view.mutable_absent();
  }
  act.set_text(std::string(task->data));
  return act;
}

std::string encode_actions(const v1::ActionChunk& chunk, const Observed& observed, const Setup& setup,
                           const Names& names, double period) {
  const auto width = static_cast<std::size_t>(chunk.d_action());
  std::vector<float> actions(chunk.actions().begin(), chunk.actions().end());
  names.to_client(actions, width);
  const auto n_row = std::min<std::int64_t>(chunk.horizon(), setup.n_action);
  pickle::Writer out;
  out.op(']').op('(');
  for (std::int64_t i = 0; i < n_row; ++i) {
    out.name(observed.module, "TimedAction").op(')').op('\x81').op('}').op('(');
    out.text("timestamp").real(observed.timestamp + static_cast<double>(i) * period);
    out.text("timestep").integer(observed.timestep + i);
    out.text("action").name("torch", "FloatTensor").op(']').op('(');
    for (std::size_t j = 0; j < width; ++j) out.real(actions[static_cast<std::size_t>(i) * width + j]);
    out.op('e').op('\x85').op('R').op('u').op('b');
  }
  return out.op('e').take();
}

bool Filter::takes(const Observed& observed) const {
  if (observed.must_go || !last_) return true;
  if (computed_.contains(observed.timestep)) return false;
  double square = 0;
  for (std::size_t i = 0; i < std::min(last_->size(), observed.state.size()); ++i) {
    const double difference = observed.state[i] - (*last_)[i];
    square += difference * difference;
  }
  return !(std::sqrt(square) < 1);
}

void Filter::computes(const Observed& observed) {
  if (computed_.size() == kMaxComputed) computed_.erase(computed_.begin());
  computed_.insert(observed.timestep);
  last_ = observed.state;
}

}  // namespace vla::serve::lerobot
