// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <cmath>

#include "base/file.h"
#include "cli/check_robot.h"
#include "cli/commands.h"
#include "cli/say.h"
#include "processor/image.h"
#include "serve/first_frames.h"
#include "serve/names.h"
#include "serve/native/codec.h"
#include "serve/protocols.h"
#include "serve/server.h"

namespace vla::cli {
namespace {

struct CheckOptions {
  std::string bundle, door, embodiment, save, robot;
  std::optional<std::string> text;
  std::vector<std::string> images;   // KEY=FILE
  std::vector<std::string> cameras;  // cameras of the robot
  std::vector<float> state;          // readings of the robot's motors
  serve::ServerOptions server;       // the options that vla serve would get
};

std::string numbers_told(const google::protobuf::RepeatedPtrField<v1::Dimension>& numbers) {
  std::vector<std::string> told;
  for (int i = 0; i < numbers.size(); ++i) {
    const std::string name = numbers[i].name().empty() ? "unnamed" : numbers[i].name();
    told.push_back(
        fmt::format("{} {}{}", i, name, numbers[i].unit().empty() ? "" : fmt::format(" [{}]", numbers[i].unit())));
  }
  return fmt::format("{}", fmt::join(told, ", "));
}

const v1::ViewSpec& view_of(const v1::Description& description, const std::string& name) {
  return *std::find_if(description.views().begin(), description.views().end(),
                       [&](const v1::ViewSpec& view) { return view.name() == name; });
}

void print_views(const serve::Names& names, const v1::Description& description) {
  for (const serve::Names::Entry& entry : names.views) {
    const v1::ViewSpec& view = view_of(description, entry.feature);
    say(stdout, "{}\n    feeds the view {}: {}, seen as {} x {}{}\n", entry.key, view.name(),
        entry.convention.is_bgr ? "blue first" : "RGB", view.width(), view.height(),
        view.camera_width() > 0 ? fmt::format(", {} x {} in training", view.camera_width(), view.camera_height()) : "");
  }
  for (const v1::ViewSpec& view : description.views()) {
    const auto is_it = [&](const serve::Names::Entry& entry) { return entry.feature == view.name(); };
    const bool is_absent = std::find(names.absent.begin(), names.absent.end(), view.name()) != names.absent.end();
    if (std::any_of(names.views.begin(), names.views.end(), is_it)) continue;
    say(stdout, "no key\n    feeds the view {}: {}\n", view.name(),
        is_absent ? "absent, as --absent says" : "it may be left out, and is absent then");
  }
}

void print_states(const serve::Names& names, const v1::Description& description) {
  for (const v1::StateSpec& state : description.states()) {
    std::vector<std::string> keys;
    for (const serve::Names::Entry& entry : names.states) {
      if (entry.feature != state.name()) continue;
      const serve::Convention& c = entry.convention;
      keys.push_back(
          fmt::format("{}{}{}", entry.key, c.is_degrees ? " (degrees)" : "", c.is_flipped ? " (1 - x)" : ""));
    }
    say(stdout, "{}\n    {} the state {}, {} numbers: {}\n", fmt::format("{}", fmt::join(keys, ", ")),
        keys.size() == 1 ? "feeds" : "feed, joined in this order,", state.name(), state.dimensions_size(),
        numbers_told(state.dimensions()));
  }
}

void print_rest(const serve::Names& names, const v1::Description& description) {
  if (description.max_text_tokens() > 0) say(stdout, "{}\n    is the instruction\n", names.text);
  for (const serve::Names::Entry& entry : names.ignored) say(stdout, "{}\n    is not looked at\n", entry.key);
  say(stdout, "actions\n    {} rows of {}{}{}\n", description.horizon(), numbers_told(description.actions()),
      description.rate_hz() > 0 ? fmt::format("; {:g} rows a second", description.rate_hz())
                                : "; control rate unstated",
      description.n_action_steps() > 0
          ? fmt::format("; {} are executed before the next look", description.n_action_steps())
          : "");
  for (const serve::Names::Columns& columns : names.actions)
    say(stdout, "    columns {} to {} come back{}{}\n", columns.begin, columns.end - 1,
        columns.convention.is_degrees ? " in degrees" : "", columns.convention.is_flipped ? " as 1 - x" : "");
}

/// Reads a client's frames from files, and writes them to the folder as the policy would see them.
Status save_frames(const CheckOptions& options, const serve::Names& names, const Engine& engine,
                   Observation& observation) {
  for (const std::string& image : options.images) {
    const std::size_t equals = image.find('=');
    const std::string key = image.substr(0, equals);
    const auto entry =
        std::find_if(names.views.begin(), names.views.end(), [&](const auto& view) { return view.key == key; });
    if (equals == std::string::npos || entry == names.views.end())
      return Error{Code::usage, "--image", "KEY=FILE with a key that feeds a view", image};
    VLA_TRY(const std::vector<std::byte> bytes, read_file(image.substr(equals + 1), std::size_t{1} << 30));
    VLA_TRY(Frame frame, decode_image(bytes, key));
    observation.views.emplace(entry->feature, std::move(frame));
  }
  VLA_TRY(const std::vector<std::string> files, serve::save_first_frames(observation, engine.robot(), options.save));
  for (const std::string& file : files) say(stdout, "{}\n    is what the policy sees\n", file);
  return {};
}

/// Computes the policy's chunk for the observation, as the robot would get it. Writes a plot, and prints the largest
/// first step of a motor.
Status save_chunk(const CheckOptions& options, const RobotModel& robot, const serve::Names& names, Engine& engine,
                  Observation observation) {
  const std::size_t n = robot.motors.size();
  if (options.state.size() != n)
    return Error{Code::usage, "--state", fmt::format("{} numbers, as {} shows its motors", n, robot.name),
                 std::to_string(options.state.size())};
  for (const std::string& view : names.absent) observation.views[view] = std::nullopt;
  std::vector<float>& state = observation.states[names.states.front().feature];
  for (const float value : options.state) state.push_back(names.states.front().convention.to_policy(value));
  observation.text = options.text;
  VLA_TRY(ActionChunk chunk, engine.act(observation, Noise(std::uint64_t{0})));
  const std::vector<std::string>& columns = engine.robot().processor().action_names();
  names.to_client(chunk.actions, columns.size());
  for (const std::string& note : chunk.notes) say(stdout, "note: {}\n", note);
  std::vector<std::optional<float>> before(columns.size());
  for (std::size_t i = 0; i < std::min(n, columns.size()); ++i) before[i] = options.state[i];
  const auto step = [&](std::size_t i) { return before[i] ? std::abs(chunk.actions[i] - *before[i]) : 0.0f; };
  std::size_t most = 0;
  for (std::size_t i = 0; i < columns.size(); ++i) most = step(i) > step(most) ? i : most;
  say(stdout, "first row\n    moves {} most: from {:.4g} to {:.4g}, if actions are positions\n",
      robot.motors[most].name, options.state[most], chunk.actions[most]);
  const std::string file = options.save + "/chunk.svg";
  const std::string plot = plot_chunk(chunk.actions, columns, before);
  VLA_CHECK(write_file(file, std::as_bytes(std::span(plot))));
  say(stdout, "{}\n    is the first chunk, and where the robot is before it\n", file);
  return {};
}

Status check_robot(const CheckOptions& options) {
  const auto& models = robot_models();
  const auto robot =
      std::find_if(models.begin(), models.end(), [&](const RobotModel& model) { return model.name == options.robot; });
  const bool acts = !options.state.empty() || options.text;
  VLA_TRY(
      const std::unique_ptr<Engine> engine,
      Engine::load(options.bundle, {.dry = !acts, .absent = options.server.absent, .embodiment = options.embodiment}));
  const v1::Description description = serve::describe(*engine, {});
  VLA_TRY(const serve::Names names, serve::names_of("lerobot", options.server, description));
  const RobotCheck check{*robot, options.cameras.empty() ? robot->cameras : options.cameras, names, description,
                         engine->robot()};
  const int n_problem = check.print();
  Observation observation;
  if (!options.images.empty()) VLA_CHECK(save_frames(options, names, *engine, observation));
  if (n_problem > 0)
    return Error{Code::usage, "--robot " + options.robot, "a robot that fits the policy",
                 fmt::format("{} problem{}, listed above", n_problem, n_problem == 1 ? "" : "s"),
                 "docs/robots.md goes through them"};
  return acts ? save_chunk(options, *robot, names, *engine, std::move(observation)) : Status();
}

Status check(const CheckOptions& options) {
  if (options.door.empty() == options.robot.empty())
    return Error{Code::usage, "--door", "--door PROTOCOL, or --robot MODEL", options.door.empty() ? "none" : "both"};
  if (options.images.empty() != options.save.empty())
    return Error{Code::usage, "--save", "--image KEY=FILE and --save DIR together", "one of them"};
  if (!options.robot.empty()) return check_robot(options);
  VLA_TRY(
      const std::unique_ptr<Engine> engine,
      Engine::load(options.bundle, {.dry = true, .absent = options.server.absent, .embodiment = options.embodiment}));
  const v1::Description description = serve::describe(*engine, {});
  VLA_TRY(const serve::Names names, serve::names_of(options.door, options.server, description));
  print_views(names, description);
  print_states(names, description);
  print_rest(names, description);
  Observation observation;
  return options.images.empty() ? Status() : save_frames(options, names, *engine, observation);
}

}  // namespace

Command add_check(CLI::App& app) {
  auto options = std::make_shared<CheckOptions>();
  CLI::App* command = app.add_subcommand("check", "Show which key of a client feeds which input of a policy");
  command->footer(
      "It takes the options that vla serve would be given, and loads no weights.\n"
      "  vla check policy.gguf --door openpi --preset libero --absent right_wrist_0_rgb\n"
      "  vla check policy.gguf --door lerobot --image observation.images.top=top.png --save seen\n"
      "  vla check policy.gguf --robot so101 --camera front --map observation.images.front=top\n"
      "  vla check policy.gguf --robot so101 --camera top --image observation.images.top=top.png --save seen \\\n"
      "            --state 0,-90,90,0,0,5 --text 'pick up the cube'   # computes: the first chunk as a plot\n"
      "Frames as they come from a robot: vla serve --first-frames DIR.");
  add_bundle(*command, options->bundle, true);
  command
      ->add_option("--door", options->door,
                   "The protocol: openpi, gr00t, lerobot, or native, that of vla's own clients")
      ->check(CLI::IsMember(serve::protocols()));
  std::vector<std::string> models;
  for (const RobotModel& model : robot_models()) models.emplace_back(model.name);
  command
      ->add_option("--robot", options->robot,
                   "Instead: a robot of LeRobot, whose motors are compared with the policy's columns, name by name")
      ->type_name("MODEL")
      ->check(CLI::IsMember(models));
  command
      ->add_option("--camera", options->cameras,
                   "A camera of the robot's configuration; several times. Of aloha not given: its four")
      ->type_name("NAME")
      ->allow_extra_args(false);
  command
      ->add_option("--state", options->state,
                   "Where the motors are, in their order and unit: then the first chunk is computed, and with --save "
                   "plotted")
      ->type_name("v,v,...")
      ->delimiter(',');
  command->add_option("--text", options->text, "The instruction of that chunk")->type_name("TEXT");
  add_text(*command, "--preset", options->server.preset, "NAME", "As for vla serve: " + serve::presets());
  command->add_option("--map", options->server.map, "As for vla serve; several times")
      ->type_name("LINE")
      ->allow_extra_args(false);
  add_absent(*command, options->server.absent);
  add_text(*command, "--embodiment", options->embodiment, "TAG", kEmbodimentHelp);
  command
      ->add_option("--image", options->images,
                   "A frame under the client's key, of which --save writes what the policy sees; several times")
      ->type_name("KEY=FILE")
      ->allow_extra_args(false);
  add_text(*command, "--save", options->save, "DIR", "A folder for these pictures, which are PNG files");
  return [options] { return check(*options); };
}

}  // namespace vla::cli
