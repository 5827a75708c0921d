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

/// What a page asks of who wants to see it: 128 bits of the system's, as hexadecimal digits.
std::string drawn_token();

/// Adds the ranges of a robot's states in training: extremes or, where the bundle has none, three deviations around
/// the mean. Keys are `tag/state`.
void add_ranges(const Robot& robot, std::map<std::string, observe::Page::Range>& ranges);

/// How a policy that is loaded is shown: where its states were in training, where its actions may be, and how it sees.
/// The engine outlives the page.
void describe_for_page(observe::Page& page, const v1::Description& description, const Engine& engine,
                       const std::optional<control::Limits>& limits);

void add_observability_options(CLI::App& command, ObservabilityOptions& options);

/// Everything that watches a server: what the options ask for, and nothing else. It lives as long as the server runs.
class Observability {
 public:
  /// Before the bundle is loaded, so that readiness can be polled. Errors: usage, io.
  static Result<std::unique_ptr<Observability>> start(const ObservabilityOptions& options, const serve::Server& server,
                                                      bool insecure);
  ~Observability();

  /// A policy is loaded that answers under this name; all of them are warm, after so many milliseconds.
  void loaded(const std::string& name, const Engine& engine);
  void ready(double warm_up_ms);
  /// A protocol lets clients in without keys while the server's own asks for them.
  void without_keys(const char* option, const std::string& address, bool has_token);
  /// A policy answers no more.
  void unloaded(const std::string& name);
  /// How the server ended. The log says so.
  void ended(const Status& status);

  std::vector<observe::Observer*> observers();
  /// The address where HTTP listens; empty where it does not.
  std::string metrics_address() const { return monitor_ ? monitor_->address() : std::string(); }
  /// The URL of the page, with its token; empty where there is none.
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
  std::unique_ptr<observe::Monitor> monitor_;  // last: asks the others
};

}  // namespace vla::cli
