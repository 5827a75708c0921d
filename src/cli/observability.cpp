// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cli/observability.h"

#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <iterator>
#include <limits>
#include <random>

#include "cli/commands.h"
#include "serve/native/codec.h"
#include "serve/native/seen.h"
#include "serve/token.h"

namespace vla::cli {
namespace {

using observe::Level;

/// With --log the level is info, otherwise warn.
Level level_of(const ObservabilityOptions& options) {
  const auto found = std::find(std::begin(observe::kLevelNames), std::end(observe::kLevelNames), options.level);
  if (found == std::end(observe::kLevelNames)) return options.log.empty() ? Level::warn : Level::info;
  return static_cast<Level>(found - std::begin(observe::kLevelNames));
}

}  // namespace

void add_ranges(const Robot& robot, std::map<std::string, observe::Page::Range>& ranges) {
  for (const std::string& state : robot.processor().states().names()) {
    const auto stats = [&](const char* name) { return robot.bundle().stats(fmt::format("stats.{}.{}", state, name)); };
    observe::Page::Range range;
    for (const auto& [low, high] : {std::pair{"min", "max"}, std::pair{"q01", "q99"}})
      if (const auto a = stats(low), b = stats(high); range.low.empty() && a && b) range = {*a, *b};
    if (const auto mean = stats("mean"), deviation = stats("std"); range.low.empty() && mean && deviation) {
      range = {*mean, *mean};
      for (std::size_t i = 0; i < mean->size(); ++i)
        range.low[i] -= 3 * (*deviation)[i], range.high[i] += 3 * (*deviation)[i];
    }
    if (!range.low.empty()) ranges[robot.bundle().embodiment() + "/" + state] = std::move(range);
  }
}

std::string drawn_token() {
  std::random_device device;
  std::string token;
  for (int i = 0; i < 4; ++i) token += fmt::format("{:08x}", device());
  return token;
}

void describe_for_page(observe::Page& page, const v1::Description& description, const Engine& engine,
                       const std::optional<control::Limits>& limits) {
  std::map<std::string, observe::Page::Range> ranges, actions;
  constexpr double kNone = std::numeric_limits<double>::infinity();
  for (const control::Column& column : limits ? limits->columns : std::vector<control::Column>())
    actions[column.name] = {{column.low.value_or(-kNone)}, {column.high.value_or(kNone)}};
  for (const Robot* robot : engine.robots()) add_ranges(*robot, ranges);
  const auto max_pixels = static_cast<std::int64_t>(description.limits().max_pixels());
  page.describe(description, ranges, actions, [&engine, max_pixels](const v1::Act& act, int view) {
    return serve::seen(act, view, engine, max_pixels);
  });
}

void add_observability_options(CLI::App& command, ObservabilityOptions& options) {
  add_text(command, "--metrics", options.metrics, "ADDRESS:PORT",
           "HTTP: /metrics (Prometheus), /healthz, /readyz; port 0 takes a free one");
  CLI::Option* page = add_text(
      command, "--page", options.page, "ADDRESS:PORT",
      "A page for a browser that shows frames, actions and times as they come; the ready line has its address, "
      "which ends with a token");
  command.add_option("--log", options.log, "Format of the log on standard error: text or json")
      ->check(CLI::IsMember({"text", "json"}));
  command.add_option("--log-level", options.level, "debug (every request), info (default with --log), warn, error")
      ->check(CLI::IsMember({"debug", "info", "warn", "error"}));
  add_text(command, "--trace", options.trace, "FILE",
           "Write a trace of requests and stages for Perfetto, a .json file");
  CLI::Option* record = add_text(
      command, "--record", options.record, "DIR",
      "Keep requests and answers in this folder, for vla replay; further recordings, which the page begins, in "
      "folders below");
  command.add_option("--record-limit", options.record_limit_mb, "Largest size of all recordings together, in MB")
      ->check(CLI::Range(1, 1 << 20))
      ->capture_default_str();
  command.add_flag("--record-paused", options.record_paused, "With --record and --page: record when the page says so")
      ->needs(record, page);
}

Observability::Observability(const ObservabilityOptions& options, const serve::Server& server)
    : server_(server),
      log_(STDERR_FILENO, options.log == "json" ? observe::LogFormat::json : observe::LogFormat::text,
           level_of(options)) {}

Result<std::unique_ptr<Observability>> Observability::start(const ObservabilityOptions& options,
                                                            const serve::Server& server, bool insecure) {
  std::unique_ptr<Observability> observability(new Observability(options, server));
  VLA_CHECK(observability->open(options, insecure));
  observability->log_.event(Level::info, "start",
                            {{"version", VLA_VERSION},
                             {"pid", ::getpid()},
                             {"address", server.addresses()},
                             {"metrics", observability->metrics_address()}});
  return observability;
}

Status Observability::open(const ObservabilityOptions& options, bool insecure) {
  if (!options.trace.empty()) {
    VLA_TRY(trace_, observe::Trace::open(options.trace));
  }
  if (!options.metrics.empty()) {
    metrics_ = std::make_unique<observe::Metrics>();
    VLA_TRY(monitor_, observe::Monitor::open(options.metrics, insecure,
                                             {[this] { return metrics_->text(server_.health()); },
                                              [this] { return not_ready_reason(); }}));
  }
  if (!options.record.empty()) {
    recordings_ = std::make_unique<observe::Recordings>(options.record, options.record_limit_mb * 1'000'000);
    recordings_->on_change([this](const observe::Recordings::Standing& recording) { log_recording(recording); });
  }
  if (!options.page.empty()) {
    VLA_TRY(page_, observe::Page::open(
                       options.page, insecure,
                       {drawn_token(), serve::is_same_secret, [this] { return server_.health(); }, recordings_.get()}));
  }
  // Last, since it creates a file that must not exist yet.
  return recordings_ && !options.record_paused ? recordings_->open() : Status();
}

void Observability::log_recording(const observe::Recordings::Standing& recording) {
  if (recording.why.empty())
    log_.event(Level::info, "recording",
               {{"on", recording.on}, {"folder", recording.folder}, {"requests", recording.n_request}});
  else
    log_.event(Level::warn, "record_stopped", {{"why", recording.why}, {"requests", recording.n_request}});
}

Observability::~Observability() {
  if (trace_ && trace_->n_dropped() > 0) log_.event(Level::warn, "trace_dropped", {{"requests", trace_->n_dropped()}});
}

/// Requests that arrive between the ready line and the server's first turn wait for it, so the server counts as ready.
std::string Observability::not_ready_reason() const {
  if (const char* phase = phase_) return phase;
  const observe::Health health = server_.health();
  return health.ready || health.uptime_s == 0 ? "" : "draining";
}

void Observability::loaded(const std::string& name, const Engine& engine) {
  const v1::Description description = server_.describe(name, engine);
  if (metrics_) metrics_->describe(description, engine.memory());
  if (recordings_) recordings_->describe(description);
  if (page_) describe_for_page(*page_, description, engine, server_.limits());
  const v1::Bundle& bundle = description.bundle();
  if (phase_ != nullptr) phase_ = "warming up";
  log_.event(Level::info, "loaded",
             {{"policy", name},
              {"bundle", bundle.name()},
              {"arch", bundle.arch()},
              {"checksum", bundle.checksum()},
              {"device", description.runtime().device()},
              {"precision", description.runtime().precision()},
              {"kernels", description.runtime().kernels()},
              {"memory_mb", static_cast<double>(engine.memory().total()) / 1e6}});
}

void Observability::without_keys(const char* option, const std::string& address, bool has_token) {
  log_.event(Level::warn, "without_keys", {{"option", option}, {"address", address}, {"token", has_token}});
}

void Observability::unloaded(const std::string& name) {
  if (metrics_) metrics_->forget(name);
  log_.event(Level::info, "unloaded", {{"policy", name}});
}

void Observability::ready(double warm_up_ms) {
  phase_ = nullptr;
  log_.event(Level::info, "ready", {{"warm_up_ms", warm_up_ms}});
}

void Observability::ended(const Status& status) {
  const observe::Health health = server_.health();
  observe::Log::Fields fields = {{"chunks", health.n_chunk}, {"errors", health.n_error}, {"uptime_s", health.uptime_s}};
  if (!status) fields.emplace_back("error", status.error().message());
  log_.event(status ? Level::info : Level::error, "shutdown", fields);
}

std::vector<observe::Observer*> Observability::observers() {
  std::vector<observe::Observer*> all;
  for (observe::Observer* observer :
       std::initializer_list<observe::Observer*>{&log_, metrics_.get(), trace_.get(), recordings_.get(), page_.get()})
    if (observer != nullptr) all.push_back(observer);
  return all;
}

}  // namespace vla::cli
