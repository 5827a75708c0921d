// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "observe/replay.h"

#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <optional>
#include <thread>

#include "base/thread.h"
#include "cli/commands.h"
#include "cli/observability.h"
#include "cli/say.h"
#include "serve/native/codec.h"
#include "serve/server.h"
#include "serve/token.h"

namespace vla::cli {
namespace {

struct ReplayOptions {
  std::string folder, bundle, kernels, device, embodiment, connect, page, limits, on_limit;
  double speed = 1;
  int n_thread = 0;
  std::vector<std::string> absent;
  observe::ReplayOptions replay;
};

/// Prints how the replaying server differs from the recorded one: another bundle or other arithmetic may rightly give
/// other answers.
void announce(const v1::Description& recorded, const v1::Description& replayed) {
  const auto row = [](const char* what, const std::string& before, const std::string& now) {
    if (before != now) say(stdout, "note: {} was {} when recorded, is {} now\n", what, before, now);
  };
  row("bundle", recorded.bundle().name() + " " + recorded.bundle().checksum(),
      replayed.bundle().name() + " " + replayed.bundle().checksum());
  row("server version", recorded.runtime().server_version(), replayed.runtime().server_version());
  row("device", recorded.runtime().device(), replayed.runtime().device());
  row("precision", recorded.runtime().precision(), replayed.runtime().precision());
  row("kernels", recorded.runtime().kernels(), replayed.runtime().kernels());
}

Status report(const observe::Recording& recording, const observe::ReplayReport& report) {
  announce(recording.description(), report.replayed_by);
  if (!report.differences.empty())
    say(stdout, "{:>8}  {:>20}  {:<15}  {}\n", "request", "id", "field", "recorded -> replayed");
  for (const observe::Difference& d : report.differences)
    say(stdout, "{:>8}  {:>20}  {:<15}  {} -> {}\n", d.index, d.request_id, d.field, d.recorded, d.replayed);
  say(stdout, "{} answers the same, {} different, {} not compared\n", report.n_same, report.n_different,
      report.n_skipped);
  if (report.differences.empty()) return {};
  const observe::Difference& first = report.differences.front();
  return Error{Code::mismatch, fmt::format("request {}: {}", first.index, first.field), first.recorded, first.replayed,
               fmt::format("{} answers differ; this is the first", report.n_different)};
}

/// Returns the server options with the limits under which the requests were recorded. Errors: bad_request if `vla
/// serve` does not accept these limits.
Result<serve::ServerOptions> limits_of(const v1::Limits& limits) {
  constexpr std::uint64_t kMiB = 1 << 20, kMostMessage = 1024 * kMiB, kMostPixels = 1 << 28, kMostText = kMiB;
  if (limits.max_message_bytes() < kMiB || limits.max_message_bytes() > kMostMessage ||
      limits.max_pixels() > kMostPixels || limits.max_text_bytes() > kMostText)
    return Error{Code::bad_request, "the recorded description", "limits that vla serve takes",
                 fmt::format("{} bytes, {} pixels, {} bytes of text", limits.max_message_bytes(), limits.max_pixels(),
                             limits.max_text_bytes())};
  serve::ServerOptions options;
  options.bind = {"tcp://127.0.0.1:0"};
  options.max_message = limits.max_message_bytes();
  options.max_pixels = static_cast<std::int64_t>(limits.max_pixels());
  options.max_text = limits.max_text_bytes();
  return options;
}

/// Serves the bundle in this process, as `vla serve` would, for the time of the replay.
Result<observe::ReplayReport> replay_bundle(observe::Recording& recording, ReplayOptions& options) {
  VLA_TRY(serve::ServerOptions limits, limits_of(recording.description().limits()));
  limits.limits = options.limits, limits.on_limit = options.on_limit;
  VLA_TRY(const std::unique_ptr<serve::Server> server, serve::Server::open(limits));
  VLA_TRY(std::unique_ptr<Engine> engine, Engine::load(options.bundle, {.n_thread = options.n_thread,
                                                                        .kernels = options.kernels,
                                                                        .device = options.device,
                                                                        .absent = options.absent,
                                                                        .embodiment = options.embodiment,
                                                                        .all_robots = true}));
  VLA_CHECK(server->add(recording.description().policy(), std::move(engine)));
  VLA_CHECK(server->begin());
  options.replay.address = server->addresses().front();
  std::optional<Result<observe::ReplayReport>> result;
  VLA_TRY(std::thread client, start_thread("replay", [&]() noexcept {
            result = observe::replay(recording, options.replay);
            server->stop();
          }));
  const Status served = server->run();
  client.join();
  VLA_CHECK(served);
  return std::move(*result);
}

/// Opens the recorded policy's bundle without loading weights: the page needs only its preprocessing and normalization
/// statistics. Errors: usage for another bundle, which may preprocess frames differently.
Result<std::unique_ptr<Engine>> open_recorded(const v1::Description& recorded, const ReplayOptions& options) {
  VLA_TRY(std::unique_ptr<Engine> engine, Engine::load(options.bundle, {.n_thread = options.n_thread,
                                                                        .kernels = options.kernels,
                                                                        .device = options.device,
                                                                        .dry = true,
                                                                        .embodiment = options.embodiment,
                                                                        .all_robots = true}));
  const std::string& checksum = recorded.bundle().checksum();
  const std::string found = serve::describe(*engine, {}).bundle().checksum();
  if (found != checksum)
    return Error{Code::usage, "--bundle", "the recorded policy's bundle, checksum " + checksum, "checksum " + found};
  return engine;
}

/// Shows the recording at its own pace, then keeps its acts on the page until the process ends.
Status show(observe::Recording& recording, const ReplayOptions& options) {
  std::atomic<std::uint64_t> n_shown = 0;
  const auto health = [&n_shown] { return observe::Health{.ready = true, .n_chunk = n_shown}; };
  const v1::Description& description = recording.description();
  std::unique_ptr<Engine> engine;
  VLA_TRY(const auto action_limits, serve::read_limits({.limits = options.limits, .on_limit = options.on_limit}));
  VLA_TRY(const std::unique_ptr<observe::Page> page,
          observe::Page::open(
              options.page, false,
              {.token = drawn_token(), .is_same = serve::is_same_secret, .health = health, .is_server = false}));
  page->describe(description, {}, {}, {});
  if (!options.bundle.empty()) {
    VLA_CHECK(limits_of(description.limits()));
    VLA_TRY(engine, open_recorded(description, options));
    describe_for_page(*page, description, *engine, action_limits);
  }
  say(stdout, "page={}\n", page->url());
  std::fflush(stdout);
  std::optional<std::uint64_t> first_ns;
  for (const auto start = Clock::now(); options.replay.first == 0 || n_shown < options.replay.first;) {
    VLA_TRY(const std::optional<observe::Recording::Record> record, recording.next());
    if (!record) break;
    first_ns = std::min(first_ns.value_or(record->at_ns), record->at_ns);
    const auto after = std::chrono::duration<double, std::nano>(static_cast<double>(record->at_ns - *first_ns));
    std::this_thread::sleep_until(start + std::chrono::duration_cast<Clock::duration>(after / options.speed));
    n_shown += page->show(*record);
  }
  say(stdout, "{} acts were shown; Ctrl-C ends the page\n", n_shown.load());
  std::fflush(stdout);
  for (;;) ::pause();
}

Status replay(ReplayOptions& options) {
  VLA_TRY(observe::Recording recording, observe::Recording::open(options.folder));
  if (!options.page.empty()) return show(recording, options);
  if (!options.connect.empty()) options.replay.address = options.connect;
  VLA_TRY(const observe::ReplayReport result,
          options.bundle.empty() ? observe::replay(recording, options.replay) : replay_bundle(recording, options));
  if (options.replay.first == 0 && !recording.is_whole())
    say(stdout, "note: the recording has no end: its server was killed, or the file was cut between two requests\n");
  return report(recording, result);
}

}  // namespace

Command add_replay(CLI::App& app) {
  auto options = std::make_shared<ReplayOptions>();
  CLI::App* command = app.add_subcommand("replay", "Send recorded requests again and compare the answers bit for bit");
  command->footer(
      "Recordings are made with vla serve --record (docs/serving.md). Exit code 10: an answer differed.\n"
      "  vla replay recording --bundle policy.gguf\n"
      "  vla replay recording --connect tcp://127.0.0.1:5555\n"
      "  vla replay recording --page 127.0.0.1:8090   # asks nobody: shows it in a browser as it happened");
  command->add_option("DIR", options->folder, "The recording")->type_name("")->required();
  CLI::Option* connect = add_text(*command, "--connect", options->connect, "ENDPOINT",
                                  "Server to ask; not given, nor --bundle: tcp://127.0.0.1:5555");
  CLI::Option* bundle =
      add_text(*command, "--bundle", options->bundle, "FILE", "Serve this bundle for the replay instead");
  bundle->excludes(connect);
  add_text(*command, "--kernels", options->kernels, "NAME", std::string(kKernelsHelp) + "; with --bundle")
      ->needs(bundle);
  add_text(*command, "--device", options->device, "NAME", std::string(kDeviceHelp) + "; with --bundle")->needs(bundle);
  add_text(*command, "--embodiment", options->embodiment, "TAG", "As for vla serve; with --bundle")->needs(bundle);
  add_absent(*command, options->absent)->needs(bundle);
  add_limits(*command, options->limits, options->on_limit)->needs(bundle);
  command
      ->add_option("--threads", options->n_thread,
                   "CPU threads, with --bundle; 0 takes every core, of big and little ones the big")
      ->needs(bundle)
      ->check(CLI::Range(0, 512));
  CLI::Option* page = add_text(*command, "--page", options->page, "ADDRESS:PORT",
                               "Show the recording in a browser instead, at its own pace; the line that is printed has "
                               "the address, which ends with a token. With --bundle also what the policy saw");
  page->excludes(connect);
  command->add_option("--speed", options->speed, "With --page: so many times as fast as it happened")
      ->needs(page)
      ->check(CLI::Range(0.1, 1000.0))
      ->capture_default_str();
  command->add_option("--first", options->replay.first, "Only so many requests; 0: all")->capture_default_str();
  return [options] { return replay(*options); };
}

}  // namespace vla::cli
