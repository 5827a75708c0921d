// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>
#include <span>
#include <string>
#include <vector>

#include "engine/engine.h"
#include "serve/io.h"
#include "serve/options.h"

namespace vla::serve {

/// Computes one act of a synthetic observation with every view and the longest text, so that the first client does not
/// pay for what happens once. A policy may refuse such an observation; what fails otherwise would fail every act.
/// Milliseconds. Errors: device, out_of_memory, internal.
Result<double> warm_up(Engine& engine);

/// One resident policy behind the sockets of its front ends. It keeps nothing between requests.
class Server {
 public:
  /// Binds the addresses. Requests that come before `run` wait. Errors: usage (an address or a key that is none; an
  /// address that others can reach, without keys), io (in use, not of this machine; no file descriptors).
  static Result<std::unique_ptr<Server>> open(const ServerOptions& options, Now now = Clock::now);

  /// What was bound, ports filled in.
  std::vector<std::string> addresses() const;
  /// Of each protocol: fewer than asked for where the system gives this process few file descriptors.
  std::size_t max_connections() const { return options_.max_connections; }

  /// The policy that clients get. Errors: usage where a front end cannot carry what it takes.
  Status load(const Engine& engine);
  /// What front ends say of their names, for people; after `load`.
  std::vector<std::string> told() const;

  /// Serves on this thread, which computes, and a second one, which talks, until `stop` or the loss of the
  /// device; then answers what waits and returns. Where the policy is on a device of its own, a third thread prepares
  /// the next act meanwhile. Observers outlive the call. Once for each server, after `load`. Errors: device,
  /// out_of_memory.
  Status run(Engine& engine, std::span<Observer* const> observers = {});
  /// What `describe` is answered with once this engine is served.
  v1::Description describe(const Engine& engine) const;
  /// From any thread or signal handler.
  void stop() noexcept;
  bool is_stopping() const noexcept { return state_.stopping; }
  /// From any thread.
  Health health() const { return state_.health(exchange_); }

 private:
  Server(const ServerOptions& options, Now now) : options_(options), exchange_(limits_of(options), now), loop_(now) {}
  static Exchange::Jobs::Limits limits_of(const ServerOptions& options);

  /// An act on its way to its answer.
  struct Act {
    Answer answer;
    ActRequest request;
    EncodedObservation prepared;
    StageClock clock;
  };
  /// False when no act comes any more.
  bool prepare_next(const Engine& engine, Act& act);
  void compute(Engine& engine, Act& act);
  Status prepare(const Engine& engine, Act& act) const;
  Status respond(Engine& engine, Act& act) const;
  template <class Work>
  static void attempt(Act& act, const Work& work) noexcept;

  ServerOptions options_;
  std::span<Observer* const> observers_;
  bool records_ = false;  // one of them does
  v1::Description description_;
  ServerState state_;
  Exchange exchange_;
  net::Loop loop_;
  Io::Fronts fronts_;
};

}  // namespace vla::serve
