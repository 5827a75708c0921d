// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <CLI/CLI.hpp>
#include <atomic>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "engine/engine.h"
#include "observe/log.h"
#include "observe/metrics.h"
#include "observe/monitor.h"
#include "observe/page.h"
#include "observe/recordings.h"
#include "observe/trace.h"
#include "serve/server.h"

namespace vla::cli {

struct ObservabilityOptions {
  std::string metrics, page, log, level, trace, record;
  std::uint64_t record_limit_mb = 1024;
  bool record_paused = false;
};

/// Draws the token that a page requires: 128 random bits from the system, as hexadecimal digits.
std::string drawn_token();

/// Adds the ranges of a robot's states in training: extremes, else 1 % and 99 % quantiles, else three standard
/// deviations around the mean. Keys are `tag/state`.
void add_ranges(const Robot& robot, std::map<std::string, observe::Page::Range>& ranges);

/// Describes a loaded policy to the page: training ranges of its states, limits of its actions, and its preprocessing
/// of frames. The engine must outlive the page.
void describe_for_page(observe::Page& page, const v1::Description& description, const Engine& engine,
                       const std::optional<control::Limits>& limits);

void add_observability_options(CLI::App& command, ObservabilityOptions& options);

/// The observers of a server, those that the options ask for. They live as long as the server runs.
class Observability {
 public:
  /// Call it before the bundle is loaded, so that readiness can be polled. Errors: usage, io.
  static Result<std::unique_ptr<Observability>> start(const ObservabilityOptions& options, const serve::Server& server,
                                                      bool insecure);
  ~Observability();

  /// `loaded`: a policy is loaded and answers under this name. `ready`: all policies are warm, after this many
  /// milliseconds.
  void loaded(const std::string& name, const Engine& engine);
  void ready(double warm_up_ms);
  /// Logs that a protocol admits clients without keys although the native protocol requires them.
  void without_keys(const char* option, const std::string& address, bool has_token);
  /// A policy is unloaded.
  void unloaded(const std::string& name);
  /// Logs how the server ended.
  void ended(const Status& status);

  std::vector<observe::Observer*> observers();
  /// The address where HTTP listens; empty if it does not.
  std::string metrics_address() const { return monitor_ ? monitor_->address() : std::string(); }
  /// The URL of the page, with its token; empty if there is none.
  std::string page_url() const { return page_ ? page_->url() : std::string(); }

 private:
  Observability(const ObservabilityOptions& options, const serve::Server& server);
  Status open(const ObservabilityOptions& options, bool insecure);
  std::string not_ready_reason() const;
  void log_recording(const observe::Recordings::Standing& recording);

  const serve::Server& server_;
  std::atomic<const char*> phase_ = "loading";  // null: serving
  observe::Log log_;
  std::unique_ptr<observe::Metrics> metrics_;
  std::unique_ptr<observe::Trace> trace_;
  std::unique_ptr<observe::Recordings> recordings_;
  std::unique_ptr<observe::Page> page_;
  std::unique_ptr<observe::Monitor> monitor_;  // last member: its thread uses the others
};

}  // namespace vla::cli
