// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>
#include <fmt/ranges.h>

#include <charconv>
#include <random>

#include "base/file.h"
#include "base/npy.h"
#include "cli/commands.h"
#include "cli/json.h"
#include "cli/say.h"
#include "engine/engine.h"

namespace vla::cli {
namespace {

constexpr std::size_t kMaxFile = std::size_t{1} << 30;

struct RunOptions {
  std::string bundle, noise, out, tap, taps_out, inject, kernels, device, leftover, schedule, normalized_out,
      embodiment;
  std::vector<std::string> images, states, absent;
  std::optional<std::string> text;
  std::optional<std::uint64_t> seed;
  std::optional<int> delay;
  std::optional<double> max_guidance;
  int n_thread = 0;
  std::size_t memory = 0;
  bool json = false, strict_state = false;
};

struct NameValue {
  std::string name, value;
};

/// `NAME=VALUE`, split at the first `=`. `form` is what the option's help calls it.
Result<NameValue> split(const std::string& option, const std::string& form, const std::string& argument) {
  const std::size_t equals = argument.find('=');
  if (equals == std::string::npos || equals == 0)
    return Error{Code::usage, option, form, argument, "vla inspect lists the names of a bundle"};
  return NameValue{argument.substr(0, equals), argument.substr(equals + 1)};
}

Result<std::vector<float>> parse_numbers(const std::string& text) {
  std::vector<float> values;
  for (const char *at = text.data(), *end = at + text.size(); at != end;) {
    while (at != end && *at == ' ') ++at;
    double value;  // parsed as float32, 1e-60 would be out of range; as double it becomes the zero that is meant
    const auto [next, error] = std::from_chars(at, end, value);
    if (error != std::errc() || (next != end && *next != ',') || (next != end && next + 1 == end))
      return Error{Code::usage, "--state", "numbers separated by commas", text};
    values.push_back(static_cast<float>(value));
    at = next == end ? next : next + 1;
  }
  return values;
}

Status add_image(Observation& observation, const std::string& argument, const FeatureNames& features) {
  VLA_TRY(const NameValue image, split("--image", "NAME=FILE", argument));
  std::optional<Frame> frame;  // `NAME=`: declared absent
  if (!image.value.empty()) {
    VLA_TRY(const std::vector<std::byte> bytes, read_file(image.value, kMaxFile));
    VLA_TRY(frame, decode_image(bytes, features.place(image.name)));
  }
  if (!observation.views.emplace(image.name, std::move(frame)).second)
    return Error{Code::usage, "--image", "each view once", image.name + " twice"};
  return {};
}

Status add_state(Observation& observation, const std::string& argument, const Processor& processor) {
  // Values without a name belong to the policy's only state feature.
  std::string name, numbers = argument;
  if (argument.find('=') != std::string::npos) {
    VLA_TRY(const NameValue state, split("--state", "NAME=v,v,...", argument));
    name = state.name, numbers = state.value;
  } else if (processor.states().names().size() == 1) {
    name = processor.states().names().front();
  } else {
    return Error{Code::usage, "--state", "NAME=v,v,... because the bundle has several state features", argument};
  }
  VLA_TRY(std::vector<float> values, parse_numbers(numbers));
  if (!observation.states.emplace(name, std::move(values)).second)
    return Error{Code::usage, "--state", "each state once", name + " twice"};
  return {};
}

/// Reads float32 rows. The reference's own arrays have a leading batch dimension of one, which is dropped.
Result<NpyArray> read_rows(const std::string& file, const std::string& where) {
  VLA_TRY(const std::vector<std::byte> bytes, read_file(file, kMaxFile));
  VLA_TRY(NpyArray array, parse_npy(bytes, where));
  if (!std::holds_alternative<std::vector<float>>(array.values))
    return Error{Code::bad_observation, where, "float32 numbers", "uint8"};
  if (array.shape.size() == 3 && array.shape.front() == 1) array.shape.erase(array.shape.begin());
  return array;
}

/// Noise that is transposed would have the right count, so its shape must be the one that the solver starts from.
Result<Noise> read_noise(const RunOptions& options, const Robot& robot) {
  if (options.noise.empty()) return Noise(*options.seed);
  VLA_TRY(NpyArray array, read_rows(options.noise, "noise"));
  const std::vector<std::size_t> shape = {static_cast<std::size_t>(robot.noise_rows()),
                                          static_cast<std::size_t>(robot.d_action_padded())};
  if (array.shape != shape)
    return Error{Code::bad_observation, "noise", fmt::format("shape ({})", fmt::join(shape, ", ")),
                 fmt::format("({})", fmt::join(array.shape, ", "))};
  return Noise(std::get<std::vector<float>>(std::move(array.values)));
}

/// The last rows of a chunk that `--normalized-out` wrote.
Result<std::optional<Leftover>> read_leftover(const RunOptions& options, const Robot& robot) {
  if (options.leftover.empty()) return std::optional<Leftover>();
  VLA_TRY(NpyArray array, read_rows(options.leftover, "leftover"));
  const std::size_t width = robot.processor().action_names().size();
  if (array.shape.size() != 2 || array.shape[1] != width)
    return Error{Code::bad_observation, "leftover", fmt::format("rows of {} numbers", width),
                 fmt::format("shape ({})", fmt::join(array.shape, ", "))};
  return std::optional<Leftover>(Leftover{std::get<std::vector<float>>(std::move(array.values)), *options.delay,
                                          options.schedule, options.max_guidance});
}

void print_table(const ActionChunk& chunk, const Robot& robot) {
  const std::vector<std::string>& names = robot.processor().action_names();
  std::size_t width = 9;
  for (const std::string& name : names) width = std::max(width, name.size());
  say(stdout, "{:>4}", "step");
  for (const std::string& name : names) say(stdout, "  {:>{}}", name, width);
  say(stdout, "\n");
  for (int row = 0; row < chunk.horizon; ++row) {
    say(stdout, "{:>4}", row);
    for (int i = 0; i < chunk.d_action; ++i)
      say(stdout, "  {:>{}.4f}", chunk.actions[static_cast<std::size_t>(row * chunk.d_action + i)], width);
    say(stdout, "\n");
  }
}

void print_timing(const Timing& timing, const Engine& engine) {
  std::vector<std::string> parts;
  for (const auto& [stage, ms] : timing) parts.push_back(fmt::format("{} {:.1f}", stage, ms));
  const std::string device = engine.device().name();
  say(stdout, "ms: {}\nkernels: {}, {}{}\n", fmt::format("{}", fmt::join(parts, ", ")), engine.kernels(),
      engine.arithmetic(), device.starts_with("cpu") ? "" : ", on " + device);
}

void print_json(const ActionChunk& chunk, const Engine& engine, const RunOptions& options) {
  Json actions = Json::array();
  for (int row = 0; row < chunk.horizon; ++row) {
    const auto first = chunk.actions.begin() + row * chunk.d_action;
    actions.push_back(std::vector<float>(first, first + chunk.d_action));
  }
  Json timing = Json::object();
  for (const auto& [stage, ms] : chunk.timing) timing[stage] = static_cast<float>(ms);
  Json root;
  root["actions"] = std::move(actions);
  root["action_names"] = engine.robot().processor().action_names();
  root["timing_ms"] = std::move(timing);
  root["bundle"] = identity_json(engine.robot().bundle());
  root["kernels"] = engine.kernels();
  root["device"] = engine.device().name();
  root["precision"] = precision_name(engine.precision());
  root["notes"] = chunk.notes;
  if (options.seed && options.noise.empty()) root["seed"] = *options.seed;
  say(stdout, "{}\n", text_of(root));
}

Status check(const RunOptions& options) {
  if (!options.noise.empty() && options.seed) return Error{Code::usage, "--seed", "--noise or --seed", "both"};
  if (options.tap.empty() != options.taps_out.empty())
    return Error{Code::usage, "--tap", "--tap PATTERN and --taps-out FILE together", "one of them"};
  if (options.leftover.empty() == options.delay.has_value())
    return Error{Code::usage, "--leftover", "--leftover FILE and --delay ROWS together", "one of them"};
  if (options.leftover.empty() && (!options.schedule.empty() || options.max_guidance))
    return Error{Code::usage, "--leftover", "rows for --schedule and --max-guidance", "none"};
  return {};
}

Status write_recorded(const std::vector<Tap>& taps, const RunOptions& options) {
  if (taps.empty())
    return Error{Code::usage, "--tap", "a pattern that names a value", options.tap, "'*' records all of them"};
  return write_taps(taps, options.taps_out);
}

Status run(RunOptions& options) {
  VLA_CHECK(check(options));
  const bool drawn = options.noise.empty() && !options.seed;
  if (drawn) options.seed = std::random_device()();
  StageClock clock;
  Timing before;
  std::vector<Tap> inject;
  if (!options.inject.empty()) {
    VLA_TRY(inject, read_taps(options.inject));
  }
  VLA_TRY(const std::unique_ptr<Engine> engine, Engine::load(options.bundle, {.n_thread = options.n_thread,
                                                                              .kernels = options.kernels,
                                                                              .device = options.device,
                                                                              .tap_pattern = options.tap,
                                                                              .inject = std::move(inject),
                                                                              .absent = options.absent,
                                                                              .embodiment = options.embodiment,
                                                                              .memory = options.memory}));
  const Robot& robot = engine->robot();
  clock.lap(before, "load");
  Observation observation;
  observation.text = options.text;
  observation.reject_out_of_range = options.strict_state;
  if (options.images.empty() && !robot.processor().views().names().empty())
    return Error{Code::usage, "--image", "the frames of " + robot.processor().views().listed(), "none"};
  for (const std::string& image : options.images) VLA_CHECK(add_image(observation, image, robot.processor().views()));
  const FeatureNames& features = robot.processor().states();
  if (options.states.empty() && !features.names().empty())
    return Error{Code::usage, "--state", "the numbers of " + features.listed(), "none"};
  for (const std::string& state : options.states) VLA_CHECK(add_state(observation, state, robot.processor()));
  clock.lap(before, "decode");
  VLA_TRY(const Noise noise, read_noise(options, robot));
  VLA_TRY(const std::optional<Leftover> leftover, read_leftover(options, robot));
  VLA_TRY(ActionChunk chunk, engine->act(observation, noise, leftover));
  chunk.timing.insert(chunk.timing.begin(), before.begin(), before.end());

  if (drawn)
    say(stderr, "note: the noise is drawn with --seed {}; pass it to get the same chunk again\n", *options.seed);
  for (const std::string& note : chunk.notes) say(stderr, "note: {}\n", note);
  if (!options.taps_out.empty()) VLA_CHECK(write_recorded(chunk.taps, options));
  if (!options.out.empty())
    VLA_CHECK(write_npy(options.out, chunk.actions, static_cast<std::size_t>(chunk.horizon),
                        static_cast<std::size_t>(chunk.d_action)));
  if (!options.normalized_out.empty())
    VLA_CHECK(write_npy(options.normalized_out, chunk.normalized, static_cast<std::size_t>(chunk.horizon),
                        static_cast<std::size_t>(chunk.d_action)));
  if (options.json) {
    print_json(chunk, *engine, options);
    return {};
  }
  print_table(chunk, robot);
  print_timing(chunk.timing, *engine);
  return {};
}

/// Refuses -1, which CLI11 would wrap around, and empty text, which it would read as not given: neither may become a
/// seed.
std::string check_seed(const std::string& text) {
  std::uint64_t seed;
  const char* const end = text.data() + text.size();
  const auto [next, error] = std::from_chars(text.data(), end, seed);
  return error == std::errc() && next == end ? "" : "expected an integer from 0 to 2^64 - 1, found '" + text + "'";
}

}  // namespace

Command add_run(CLI::App& app) {
  auto options = std::make_shared<RunOptions>();
  CLI::App* command = app.add_subcommand("run", "One observation in, one action chunk out");
  command->footer(
      "NAME is a camera feature of the bundle or its last part: camera1 for observation.images.camera1 (vla inspect "
      "lists\n"
      "them). NAME= declares a view absent; a view that is simply not mentioned is an error.\n"
      "  vla run policy.gguf --image camera1=top.png --image camera2= --state 0.1,0.2,0.3 --text \"open the drawer\" "
      "--seed 1 --json");
  add_bundle(*command, options->bundle, true);
  command
      ->add_option("--image", options->images,
                   "A frame: PNG, JPEG, or .npy (uint8 or float32 in [0, 1], height x width x 3); none for a policy "
                   "without cameras")
      ->type_name("NAME=FILE")
      ->allow_extra_args(false);
  add_absent(*command, options->absent);
  command
      ->add_option("--state", options->states, "The robot's state in its own units; NAME= where the policy has several")
      ->type_name("[NAME=]v,v,...")
      ->allow_extra_args(false);
  command
      ->add_option_function<std::string>(
          "--text", [options](const std::string& text) { options->text = text; },  // a std::optional would drop ""
          "The instruction, which may be empty; none for a policy that reads none")
      ->type_name("TEXT");
  add_text(*command, "--noise", options->noise, "FILE",
           "The solver's starting noise: a float32 .npy file, horizon x padded action width, or a batch of one of it");
  command
      ->add_option("--seed", options->seed,
                   "Draw the noise, the same on every machine; actions may differ in their last digits")
      ->type_name("N")
      ->check(CLI::Validator(check_seed, ""));
  add_text(
      *command, "--leftover", options->leftover, "FILE",
      "Real-time chunking: continue these rows of the previous chunk, the last ones of its --normalized-out (float32 "
      ".npy). vla inspect says whether the policy is guided by them or in-paints");
  command
      ->add_option("--delay", options->delay,
                   "With --leftover: how many of its rows will be executed before the new chunk arrives")
      ->type_name("N");
  command
      ->add_option("--schedule", options->schedule,
                   "With --leftover, of a guided policy: how the weight of the rows after the delay falls")
      ->type_name("NAME")
      ->check(CLI::IsMember({"zeros", "ones", "linear", "exp"}));
  command
      ->add_option("--max-guidance", options->max_guidance,
                   "With --leftover, of a guided policy: the largest weight of the guidance")
      ->type_name("W");
  command->add_flag("--json", options->json, "Print one JSON object as the last line of output");
  add_text(*command, "--out", options->out, "FILE", "Also write the chunk as float32 .npy, horizon x actions");
  add_text(*command, "--normalized-out", options->normalized_out, "FILE",
           "Also write the network's output, before unnormalization, for a later --leftover");
  add_text(*command, "--tap", options->tap, "PATTERN",
           "Record named values: a path with *, e.g. 'lm.blk.*'; commas separate patterns");
  add_text(*command, "--taps-out", options->taps_out, "FILE", "Where the recorded values go (GGUF), for vla compare");
  add_text(*command, "--inject", options->inject, "FILE",
           "Replace computed values by these: a GGUF file of named values, as --taps-out writes it");
  command->add_option("--threads", options->n_thread, "CPU threads; 0 takes every core, of big and little ones the big")
      ->type_name("N")
      ->check(CLI::Range(0, 512))
      ->capture_default_str();
  add_text(*command, "--kernels", options->kernels, "NAME", kKernelsHelp);
  add_text(*command, "--device", options->device, "NAME", kDeviceHelp);
  add_memory(*command, options->memory);
  add_text(*command, "--embodiment", options->embodiment, "TAG", kEmbodimentHelp);
  command->add_flag("--strict-state", options->strict_state, kStrictStateHelp);
  return [options] { return run(*options); };
}

}  // namespace vla::cli
