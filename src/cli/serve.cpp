// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <fcntl.h>
#include <fmt/format.h>
#include <fmt/ranges.h>
#include <unistd.h>

#include <algorithm>
#include <cctype>
#include <cerrno>
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <fstream>

#include "cli/commands.h"
#include "cli/observability.h"
#include "cli/say.h"
#include "processor/constant_actions.h"
#include "serve/names.h"
#include "serve/native/codec.h"
#include "serve/server.h"

namespace vla::cli {
namespace {

struct ServeOptions {
  std::string bundle, kernels, device, embodiment;
  int n_thread = 0;
  std::size_t memory = 0;
  bool restarts = false;
  std::size_t max_message_mb = 32;
  serve::ServerOptions server;
  ObservabilityOptions observability;
};

serve::Server* stopped_by_signals = nullptr;

/// The first SIGTERM or SIGINT lets the server finish; the next one, whichever of the two, ends the process.
void stop_on_signals(serve::Server& server) {
  stopped_by_signals = &server;
  struct sigaction action = {};
  action.sa_handler = [](int signal) {
    if (stopped_by_signals->is_stopping()) {
      std::signal(signal, SIG_DFL);
      std::raise(signal);
    }
    stopped_by_signals->stop();
  };
  sigaction(SIGTERM, &action, nullptr);
  sigaction(SIGINT, &action, nullptr);
}

/// As a shell reads it back: words as they are, anything else in quotes.
std::string quoted(const std::string& value) {
  const std::string text = printable(value);
  const auto is_plain = [](unsigned char c) { return std::isalnum(c) != 0 || std::strchr("@%+=:,./-_", c) != nullptr; };
  if (!text.empty() && std::all_of(text.begin(), text.end(), is_plain)) return text;
  std::string out = "'";
  for (const char c : text) out += c == '\'' ? std::string("'\\''") : std::string(1, c);
  return out + "'";
}

/// One line that programs can split as a shell would.
void print_ready(const serve::Server& server, const Engine& engine, double load_ms, double warm_up_ms,
                 const Observability& observability) {
  std::vector<std::string> features, tags, degraded, constant;  // of all robots
  const auto add_new = [](std::vector<std::string>& all, const std::vector<std::string>& some) {
    for (const std::string& text : some)
      if (!text.empty() && std::find(all.begin(), all.end(), text) == all.end()) all.push_back(text);
  };
  for (const Robot* robot : engine.robots()) {
    add_new(features, robot->processor().views().names());
    add_new(features, robot->processor().states().names());
    add_new(degraded, robot->processor().degraded());
    add_new(constant, constant_actions(robot->processor(), robot->solver_horizon(), robot->d_action_padded()));
    add_new(tags, {robot->bundle().embodiment()});
  }
  const v1::Description description = serve::describe(engine, {});
  std::string line = "ready";
  const auto add = [&](const char* name, const std::string& value) {
    line += fmt::format(" {}={}", name, quoted(value));
  };
  add("address", fmt::format("{}", fmt::join(server.addresses(), ",")));
  if (const auto names = server.told(); !names.empty()) add("names", fmt::format("{}", fmt::join(names, "; ")));
  add("bundle", description.bundle().name());
  add("arch", description.bundle().arch());
  if (!tags.empty()) add("embodiments", fmt::format("{}", fmt::join(tags, ",")));
  add("device", description.runtime().device());
  add("precision", description.runtime().precision());
  add("kernels", description.runtime().kernels());
  add("memory_mb", fmt::format("{:.1f}", static_cast<double>(engine.memory().total()) / 1e6));
  if (const std::size_t n_read = engine.budget().n_read; n_read > 0)
    add("read_mb", fmt::format("{:.1f}", static_cast<double>(n_read) / 1e6));
  add("connections", std::to_string(server.max_connections()));
  add("features", fmt::format("{}", fmt::join(features, ",")));
  add("load_ms", fmt::format("{:.1f}", load_ms));
  add("warm_up_ms", fmt::format("{:.1f}", warm_up_ms));
  if (const std::string metrics = observability.metrics_address(); !metrics.empty()) add("metrics", metrics);
  if (const std::string page = observability.page_url(); !page.empty()) add("page", page);
  if (!constant.empty()) add("CONSTANT", fmt::format("{}", fmt::join(constant, ",")));
  if (!degraded.empty()) add("DEGRADED", fmt::format("{}", fmt::join(degraded, ",")));
  say(stdout, "{}\n", line);
  std::fflush(stdout);
}

/// The program in place of this process, with the same arguments: a driver that has lost its device finds it again in
/// no other way. Returns where that fails.
Error start_again() {
  std::error_code failed;
  const std::string program = std::filesystem::read_symlink("/proc/self/exe", failed);
  std::ifstream file("/proc/self/cmdline");
  std::vector<std::string> arguments;
  for (std::string argument; std::getline(file, argument, '\0');) arguments.push_back(argument);
  std::vector<char*> pointers;
  for (std::string& argument : arguments) pointers.push_back(argument.data());
  pointers.push_back(nullptr);
  for (const auto& entry : std::filesystem::directory_iterator("/proc/self/fd", failed))  // those of drivers
    if (const int fd = std::atoi(entry.path().filename().c_str()); fd > STDERR_FILENO) ::fcntl(fd, F_SETFD, FD_CLOEXEC);
  ::execv(program.c_str(), pointers.data());
  return {Code::io, program, "a program that starts again", std::strerror(errno)};
}

/// `ready`: whether it came as far as that.
Status serve(ServeOptions& options, bool& ready) {
  options.server.max_message = options.max_message_mb << 20;
  VLA_TRY(const std::unique_ptr<serve::Server> server, serve::Server::open(options.server));
  VLA_TRY(const std::unique_ptr<Observability> observability,
          Observability::start(options.observability, *server, options.server.insecure));
  StageClock clock;
  Timing load;
  VLA_TRY(const std::unique_ptr<Engine> engine, Engine::load(options.bundle, {.n_thread = options.n_thread,
                                                                              .kernels = options.kernels,
                                                                              .device = options.device,
                                                                              .embodiment = options.embodiment,
                                                                              .all_robots = true,
                                                                              .memory = options.memory}));
  clock.lap(load, "load");
  VLA_CHECK(server->load(*engine));
  observability->loaded(*engine);
  VLA_TRY(const double warm_up_ms, serve::warm_up(*engine));
  stop_on_signals(*server);
  observability->ready(warm_up_ms);
  print_ready(*server, *engine, load.front().second, warm_up_ms, *observability);
  ready = true;
  const Status status = server->run(*engine, observability->observers());
  observability->ended(status);
  return status;
}

/// What lets clients of other servers in as they are.
void add_other_protocols(CLI::App& command, serve::ServerOptions& server) {
  add_text(command, "--openpi", server.openpi, "ADDRESS:PORT",
           "Answer openpi's clients too: WebSocket (docs/drop_in.md)");
  add_text(command, "--gr00t", server.gr00t, "ADDRESS:PORT", "Answer the clients of GR00T's policy server too");
  add_text(command, "--lerobot", server.lerobot, "ADDRESS:PORT",
           "Answer the robot_client of LeRobot too; in builds with libgrpc++");
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

Command add_serve(CLI::App& app) {
  auto options = std::make_shared<ServeOptions>();
  serve::ServerOptions& server = options->server;
  CLI::App* command = app.add_subcommand("serve", "Keep a policy loaded and answer clients over the network");
  command->footer(
      "Clients: docs/serving.md; the protocol: docs/protocol.md. SIGTERM or Ctrl-C finishes the act that runs, then "
      "ends.\n"
      "  vla serve policy.gguf\n"
      "  vla serve policy.gguf --bind tcp://0.0.0.0:5555 --curve-secret server.secret --curve-clients clients.public");
  add_bundle(*command, options->bundle, true);
  command
      ->add_option("--bind", server.bind,
                   "tcp://ADDRESS:PORT (port 0: a free one) or ipc://PATH; may be given several times")
      ->type_name("ENDPOINT")
      ->allow_extra_args(false)
      ->capture_default_str();
  add_other_protocols(*command, server);
  command->add_option("--threads", options->n_thread, "CPU threads; 0 takes every core, of big and little ones the big")
      ->check(CLI::Range(0, 512))
      ->capture_default_str();
  add_text(*command, "--kernels", options->kernels, "NAME", kKernelsHelp);
  add_text(*command, "--device", options->device, "NAME", kDeviceHelp);
  add_memory(*command, options->memory);
  add_text(*command, "--embodiment", options->embodiment, "TAG",
           "Serve one robot of a bundle for several; not given: all");
  command->add_option("--max-message", options->max_message_mb, "Largest request, in MiB")
      ->check(CLI::Range(1, 1024))
      ->capture_default_str();
  command
      ->add_option("--max-pixels", server.max_pixels,
                   "What the images of an act may cost together, in pixels: docs/security.md")
      ->check(CLI::Range(1, 1 << 28))
      ->capture_default_str();
  command->add_option("--max-text", server.max_text, "Longest instruction, in bytes")
      ->check(CLI::Range(1, 1 << 20))
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
  command->add_flag("--insecure", server.insecure, "Allow addresses that other machines reach, without keys");
  command->add_option("--curve-secret", server.curve_secret, "The server's secret key, a file from vla keygen")
      ->check(CLI::ExistingFile);
  command->add_option("--curve-clients", server.curve_clients, "Public keys of the admitted clients, one per line")
      ->check(CLI::ExistingFile);
  add_observability_options(*command, options->observability);
  command
      ->add_flag("--restart-on-device-loss", options->restarts,
                 "Start again when a GPU is lost; not given: end with exit code 8")
      ->excludes("--trace", "--record");  // which the second start would find in its way
  return [options] {
    bool ready = false;
    const Status status = serve(*options, ready);
    const bool lost = ready && !status && status.error().code == Code::device;
    return lost && options->restarts ? start_again() : status;
  };
}

}  // namespace vla::cli
