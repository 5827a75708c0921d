// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <fcntl.h>
#include <fmt/format.h>
#include <fmt/ranges.h>
#include <unistd.h>

#include <algorithm>
#include <cctype>
#include <cerrno>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <map>

#include "cli/commands.h"
#include "cli/kept_memory.h"
#include "cli/observability.h"
#include "cli/say.h"
#include "cli/signals.h"
#include "processor/constant_actions.h"
#include "serve/control.h"
#include "serve/names.h"
#include "serve/native/codec.h"
#include "serve/server.h"
#include "serve/warm_up.h"

namespace vla::cli {
namespace {

struct ServeOptions {
  std::vector<std::string> bundles;  // FILE or NAME=FILE
  std::string kernels, device, embodiment, control, sizes;
  int n_thread = 0;
  std::size_t memory = 0;
  bool restarts = false;
  std::size_t max_message_mb = 32;
  serve::ServerOptions server;
  ObservabilityOptions observability;
};

constexpr std::chrono::milliseconds kLoadPatience(500);  // at the end, for an order that loads a policy

serve::Server* stopped_by_signals = nullptr;

/// The first signal lets the server finish; the next one, whichever it is, ends the process.
void stop_or_end(int signal) {
  if (stopped_by_signals->is_stopping()) EndSignals::end_by(signal);
  stopped_by_signals->stop();
}

/// Quotes a value for a shell; plain words stay unquoted.
std::string quoted(const std::string& value) {
  const std::string text = printable(value);
  const auto is_plain = [](unsigned char c) { return std::isalnum(c) != 0 || std::strchr("@%+=:,./-_", c) != nullptr; };
  if (!text.empty() && std::all_of(text.begin(), text.end(), is_plain)) return text;
  std::string out = "'";
  for (const char c : text) out += c == '\'' ? std::string("'\\''") : std::string(1, c);
  return out + "'";
}

/// A line that programs can split as a shell would.
class Line {
 public:
  explicit Line(std::string first) : text_(std::move(first)) {}
  Line& add(const char* name, const std::string& value) {
    text_ += fmt::format(" {}={}", name, quoted(value));
    return *this;
  }
  /// Adds nothing if there are no values.
  Line& add(const char* name, const std::vector<std::string>& values, const char* between = ",") {
    return values.empty() ? *this : add(name, fmt::format("{}", fmt::join(values, between)));
  }
  void print() const {
    say(stdout, "{}\n", text_);
    std::fflush(stdout);
  }

 private:
  std::string text_;
};

void add_policy(Line& line, const serve::LoadedPolicy& policy) {
  const Engine& engine = *policy.engine;
  std::vector<std::string> tags;
  for (const Robot* robot : engine.robots())
    if (const std::string& tag = robot->bundle().embodiment(); !tag.empty()) tags.push_back(tag);
  const v1::Description description = serve::describe(engine, {});
  line.add("bundle", description.bundle().name()).add("arch", description.bundle().arch()).add("embodiments", tags);
  line.add("device", description.runtime().device()).add("precision", description.runtime().precision());
  line.add("kernels", description.runtime().kernels());
  line.add("memory_mb", fmt::format("{:.1f}", static_cast<double>(engine.memory().total()) / 1e6));
  if (const std::size_t n_read = engine.budget().n_read; n_read > 0)
    line.add("read_mb", fmt::format("{:.1f}", static_cast<double>(n_read) / 1e6));
}

/// Adds the facts that a user has to know before the policy moves a robot.
void add_features(Line& line, const serve::LoadedPolicy& policy) {
  std::vector<std::string> features, degraded, constant;  // collected over all robots
  const auto add_new = [](std::vector<std::string>& all, const std::vector<std::string>& some) {
    for (const std::string& text : some)
      if (!text.empty() && std::find(all.begin(), all.end(), text) == all.end()) all.push_back(text);
  };
  for (const Robot* robot : policy.engine->robots()) {
    add_new(features, robot->processor().views().names());
    add_new(features, robot->processor().states().names());
    add_new(degraded, robot->processor().degraded());
    add_new(constant, constant_actions(robot->processor(), robot->solver_horizon(), robot->d_action_padded()));
  }
  line.add("features", features).add("load_ms", fmt::format("{:.1f}", policy.load_ms));
  line.add("warm_up_ms", fmt::format("{:.1f}", policy.warm_up_ms)).add("CONSTANT", constant).add("DEGRADED", degraded);
}

/// Prints a single line for one policy. For several, prints one line each, then one for the server.
void print_ready(const serve::Server& server, const std::map<std::string, serve::LoadedPolicy>& policies,
                 const ServeOptions& options, const Observability& observability) {
  const bool is_one = policies.size() == 1;
  for (const auto& [name, policy] : policies) {
    if (is_one) break;
    Line line("policy");
    add_policy(line.add("name", name), policy);
    add_features(line, policy);
    line.print();
  }
  Line line("ready");
  line.add("address", server.addresses()).add("names", server.told(), "; ");
  if (is_one) add_policy(line, policies.begin()->second);
  if (!is_one) {
    std::vector<std::string> names;
    for (const auto& [name, policy] : policies) names.push_back(name);
    line.add("policies", names);
  }
  line.add("connections", std::to_string(server.max_connections()));
  if (is_one) add_features(line, policies.begin()->second);
  if (const std::string metrics = observability.metrics_address(); !metrics.empty()) line.add("metrics", metrics);
  if (const std::string page = observability.page_url(); !page.empty()) line.add("page", page);
  if (!options.control.empty()) line.add("control", options.control);
  line.print();
}

/// Runs the program again in place of this process, with the same arguments: a driver finds a lost device again in no
/// other way. Returns only if that fails.
Error start_again() {
  std::error_code failed;
  const std::string program = std::filesystem::read_symlink("/proc/self/exe", failed);
  std::ifstream file("/proc/self/cmdline");
  std::vector<std::string> arguments;
  for (std::string argument; std::getline(file, argument, '\0');) arguments.push_back(argument);
  std::vector<char*> pointers;
  for (std::string& argument : arguments) pointers.push_back(argument.data());
  pointers.push_back(nullptr);
  for (const auto& entry : std::filesystem::directory_iterator("/proc/self/fd", failed))  // drivers' descriptors
    if (const int fd = std::atoi(entry.path().filename().c_str()); fd > STDERR_FILENO) ::fcntl(fd, F_SETFD, FD_CLOEXEC);
  ::execv(program.c_str(), pointers.data());
  return {Code::io, program, "a program that starts again", std::strerror(errno)};
}

/// Loads a policy with the server's options, from a file or a hub.
Result<serve::LoadedPolicy> load_policy(const ServeOptions& options, std::string bundle) {
  if (std::string problem = find_pulled(bundle); !problem.empty()) return Error{Code::usage, bundle, "", problem};
  serve::LoadedPolicy policy;
  StageClock clock;
  Timing load;
  VLA_TRY(policy.engine, Engine::load(bundle, {.n_thread = options.n_thread,
                                               .kernels = options.kernels,
                                               .device = options.device,
                                               .absent = options.server.absent,
                                               .embodiment = options.embodiment,
                                               .all_robots = true,
                                               .memory = options.memory}));
  clock.lap(load, "load");
  policy.load_ms = load.front().second;
  return policy;
}

/// Checks that recordings and the page get a single policy, which stays the same.
Status check_single(const ServeOptions& options) {
  const char* of_one = !options.observability.record.empty() ? "--record"
                       : !options.observability.page.empty() ? "--page"
                                                             : nullptr;
  if (of_one == nullptr || (options.bundles.size() == 1 && options.control.empty())) return {};
  return Error{Code::usage, of_one, "one bundle, without --control",
               options.control.empty() ? std::to_string(options.bundles.size()) + " bundles" : "--control",
               "it shows one policy; serve the others from another process"};
}

/// The bundles by the names of their policies.
Result<std::map<std::string, std::string>> named_bundles(const std::vector<std::string>& given) {
  std::map<std::string, std::string> bundles;
  for (const std::string& text : given) {
    const auto [name, bundle] = serve::named_bundle(text);
    if (given.size() > 1) VLA_CHECK(serve::check_policy_name(name));
    if (!bundles.emplace(name, bundle).second)
      return Error{Code::usage, "BUNDLE", "policies of different names", "two of " + name, "name one: NAME=FILE"};
  }
  return bundles;
}

/// Ends the process with success, since the loading of a bundle cannot be interrupted. Log, trace and recordings are
/// closed first.
[[noreturn]] void end_while_loading(std::unique_ptr<Observability>& observability) {
  observability.reset();
  std::_Exit(0);
}

/// Warns of protocols that admit everybody although the native protocol has keys.
void warn_of_doors_without_keys(const serve::ServerOptions& server, Observability& observability) {
  if (server.curve_secret.empty()) return;
  for (const auto& [option, address] : {std::pair{"--openpi", &server.openpi}, std::pair{"--gr00t", &server.gr00t},
                                        std::pair{"--lerobot", &server.lerobot}}) {
    const bool has_token = !server.api_token.empty() && address != &server.lerobot;
    if (!address->empty()) observability.without_keys(option, *address, has_token);
  }
}

/// `ready`: set once the server is ready.
Status serve(ServeOptions& options, bool& ready) {
  KeptMemory memory;
  VLA_CHECK(check_single(options));
  VLA_TRY(const auto bundles, named_bundles(options.bundles));
  options.server.max_message = options.max_message_mb << 20;
  VLA_TRY(const std::unique_ptr<serve::Server> server, serve::Server::open(options.server));
  VLA_TRY(std::unique_ptr<Observability> observability,
          Observability::start(options.observability, *server, options.server.insecure));
  std::unique_ptr<serve::SeenSizes> sizes;
  if (!options.sizes.empty()) {
    VLA_TRY(sizes, serve::SeenSizes::open(options.sizes, [](const Error& error) {
              say(stderr, "warning: --warm-up: {}\n", error.message());
            }));
  }
  const auto warm_up = [&](Engine& engine) {
    return serve::warm_up(engine, sizes ? sizes->of(engine) : std::vector<ActShape>());
  };
  server->keep_sizes(sizes.get());
  warn_of_doors_without_keys(options.server, *observability);
  std::unique_ptr<serve::Control> control;
  if (!options.control.empty()) {
    const auto load = [&options, &warm_up](const std::string& bundle) -> Result<serve::LoadedPolicy> {
      VLA_TRY(serve::LoadedPolicy policy, load_policy(options, bundle));
      VLA_TRY(policy.warm_up_ms, warm_up(*policy.engine));
      return policy;
    };
    Observability& observed = *observability;
    VLA_TRY(control,
            serve::Control::open(
                options.control, *server,
                {load, [&observed](const std::string& name, const Engine& engine) { observed.loaded(name, engine); },
                 [&observed](const std::string& name) { observed.unloaded(name); }}));
  }
  std::map<std::string, serve::LoadedPolicy> policies;
  double warm_up_ms = 0;
  for (const auto& [name, bundle] : bundles) {
    VLA_TRY(policies[name], load_policy(options, bundle));
    serve::LoadedPolicy& policy = policies[name];
    VLA_CHECK(server->add(name, policy.engine));
    observability->loaded(name, *policy.engine);
    VLA_TRY(policy.warm_up_ms, warm_up(*policy.engine));
    warm_up_ms += policy.warm_up_ms;
  }
  VLA_CHECK(server->begin());
  stopped_by_signals = server.get();
  const EndSignals signals(stop_or_end, {SIGHUP});
  observability->ready(warm_up_ms);
  print_ready(*server, policies, options, *observability);
  policies.clear();  // only the server keeps them, so that an unloaded policy is freed
  if (control) VLA_CHECK(control->start());
  ready = true;
  std::vector<serve::Observer*> observers = observability->observers();
  observers.push_back(&memory);
  const Status status = server->run(observers);
  observability->ended(status);
  if (control && !control->stop(kLoadPatience) && status) end_while_loading(observability);
  return status;
}

/// Checks the value of --on-limit. Returns the problem, or empty.
std::string check_on_limit(const std::string& given) {
  if (given == "note" || given == "refuse") return {};
  return given == "clamp"
             ? "expected note or refuse, found clamp: a server does not know where the robot is when a row "
               "is commanded; the limits of its control loop clamp (docs/control.md)"
             : "expected note or refuse, found " + given;
}

/// Adds the options for clients of other servers' protocols.
void add_other_protocols(CLI::App& command, serve::ServerOptions& server) {
  add_text(command, "--openpi", server.openpi, "ADDRESS:PORT",
           "Answer openpi's clients too: WebSocket (docs/drop_in.md)");
  add_text(command, "--gr00t", server.gr00t, "ADDRESS:PORT", "Answer the clients of GR00T's policy server too");
  add_text(command, "--lerobot", server.lerobot, "ADDRESS:PORT",
           "Answer the robot_client of LeRobot too, from a process of its own");
  add_text(command, "--preset", server.preset, "NAME",
           "With --openpi, the keys of a published robot: " + serve::presets());
  command
      .add_option(
          "--map", server.map,
          "A client's key for a view or state of the policy, KEY=FEATURE[,bgr][,degrees][,flipped]; several times")
      ->type_name("LINE")
      ->allow_extra_args(false);
  command
      .add_option("--api-token", server.api_token, "A file with the secret that clients of --openpi and --gr00t send")
      ->check(CLI::ExistingFile);
  command.add_flag("--vllm-omni", server.vllm_omni, "The clients of --openpi speak the dialect of vLLM-Omni");
  command.add_flag("--gr00t-n1-5", server.gr00t_n1_5,
                   "Describe the policy as clients of GR00T N1.5 read it, also before their first act");
  command.add_flag("--gr00t-kill", server.gr00t_kill, "Let clients of --gr00t stop the server");
}

}  // namespace

CLI::Option* add_limits(CLI::App& command, std::string& file, std::string& on_limit) {
  CLI::Option* limits =
      command.add_option("--limits", file, "What the rows of a chunk may be, a file as the control loops read it")
          ->type_name("FILE")
          ->check(CLI::ExistingFile);
  CLI::Option* what =
      command
          .add_option("--on-limit", on_limit,
                      "What becomes of a chunk with rows outside: note, or refuse; required with --limits. One with "
                      "more of them than the file permits is refused in any case")
          ->type_name("note|refuse")
          ->check(CLI::Validator(check_on_limit, ""));
  what->needs(limits);
  return limits->needs(what);
}

Command add_serve(CLI::App& app) {
  auto options = std::make_shared<ServeOptions>();
  serve::ServerOptions& server = options->server;
  CLI::App* command = app.add_subcommand("serve", "Keep a policy loaded and answer clients over the network");
  command->footer(
      "Clients: docs/serving.md; the protocol: docs/protocol.md. SIGTERM or Ctrl-C finishes the act that runs, then "
      "ends.\n"
      "  vla serve policy.gguf\n"
      "  vla serve policy.gguf --bind tcp://0.0.0.0:5555 --curve-secret server.secret --curve-clients clients.public\n"
      "  vla serve pick=a.gguf place=b.gguf --control /run/user/1000/vla.sock   # acts name theirs; vla ctl swaps "
      "them");
  command
      ->add_option("BUNDLE", options->bundles,
                   "The policy, a .gguf file from vla-convert, or the hub:OWNER/NAME@REVISION of vla-pull. Several "
                   "answer by name: NAME=BUNDLE, or that of the file")
      ->type_name("")
      ->required();
  add_text(*command, "--default-policy", server.default_policy, "NAME",
           "Of several, the one of clients that name none, as those of --openpi, --gr00t and --lerobot");
  add_text(*command, "--control", options->control, "PATH",
           "A socket through which vla ctl loads, swaps and unloads policies; for this user alone");
  command
      ->add_option("--bind", server.bind,
                   "tcp://ADDRESS:PORT (port 0: a free one) or ipc://PATH; may be given several times")
      ->type_name("ENDPOINT")
      ->allow_extra_args(false)
      ->capture_default_str();
  add_other_protocols(*command, server);
  add_absent(*command, server.absent);
  add_text(*command, "--first-frames", server.first_frames, "DIR",
           "Write what the policy sees of the first act's frames into this folder, as VIEW.png");
  command->add_option("--threads", options->n_thread, "CPU threads; 0 takes every core, of big and little ones the big")
      ->check(CLI::Range(0, 512))
      ->capture_default_str();
  add_text(*command, "--kernels", options->kernels, "NAME", kKernelsHelp);
  add_text(*command, "--device", options->device, "NAME", kDeviceHelp);
  add_memory(*command, options->memory);
  add_text(*command, "--embodiment", options->embodiment, "TAG",
           "Serve one robot of a bundle for several; not given: all");
  add_text(*command, "--warm-up", options->sizes, "FILE",
           "Keep the sizes of acts in FILE, made if it is not there, and compute one of each before the first client");
  command->add_option("--max-message", options->max_message_mb, "Largest request, in MiB")
      ->check(CLI::Range(1, 1024))
      ->capture_default_str();
  command
      ->add_option("--max-pixels", server.max_pixels,
                   "What the images of an act may cost together, in pixels: docs/security.md")
      ->check(CLI::Range(1, 1 << 28))
      ->capture_default_str();
  command->add_option("--max-text", server.max_text, "Longest instruction, in bytes")
      ->check(CLI::Range(1, static_cast<int>(serve::kMostText)))
      ->capture_default_str();
  command->add_option("--queue", server.max_queue, "Acts that may wait, one for each client; further ones are refused")
      ->check(CLI::Range(1, 4096))
      ->capture_default_str();
  command
      ->add_option("--connections", server.max_connections,
                   "Largest number of connections; the longest idle one is closed for a new one")
      ->check(CLI::Range(1, 65536))
      ->capture_default_str();
  command->add_flag("--strict-state", server.strict_state, kStrictStateHelp);
  add_limits(*command, server.limits, server.on_limit);
  command->add_flag("--insecure", server.insecure, "Allow addresses that other machines reach, without keys");
  command->add_option("--curve-secret", server.curve_secret, "The server's secret key, a file from vla keygen")
      ->check(CLI::ExistingFile);
  command->add_option("--curve-clients", server.curve_clients, "Public keys of the admitted clients, one per line")
      ->check(CLI::ExistingFile);
  add_observability_options(*command, options->observability);
  command
      ->add_flag("--restart-on-device-loss", options->restarts,
                 "Start again when a GPU is lost; not given: end with exit code 8")
      ->excludes("--trace", "--record");  // the second start would refuse the files of the first
  return [options] {
    bool ready = false;
    const Status status = serve(*options, ready);
    const bool lost = ready && !status && status.error().code == Code::device;
    return lost && options->restarts ? start_again() : status;
  };
}

}  // namespace vla::cli
