// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <atomic>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "engine/engine.h"
#include "serve/io.h"
#include "serve/names.h"
#include "serve/options.h"
#include "serve/seen_sizes.h"

namespace vla::serve {

/// The protocols that a server may speak: native, openpi, gr00t, lerobot.
std::vector<std::string> protocols();

/// The names that a protocol's clients use for a policy's views and states, with these options. Errors: usage, also if
/// the protocol cannot carry what the policy takes.
Result<Names> names_of(const std::string& protocol, const ServerOptions& options, const v1::Description& description);

/// Resident policies behind the sockets of the front ends. It keeps nothing between requests.
class Server {
 public:
  /// Binds the addresses. Requests that come before `run` wait. Errors: usage (an address or a key that is none; an
  /// address that others can reach, without keys), io (in use, not of this machine; no file descriptors).
  static Result<std::unique_ptr<Server>> open(const ServerOptions& options, Now now = Clock::now);

  /// The bound addresses, ports filled in.
  std::vector<std::string> addresses() const;
  /// The limit of each protocol: lower than asked for where the system gives this process few file descriptors.
  std::size_t max_connections() const { return options_.max_connections; }

  /// A policy that acts may name, before `run`. Errors: incompatible, as Policies::put; usage, where --limits are of
  /// other actions.
  Status add(const std::string& name, std::shared_ptr<Engine> engine);
  /// The same while it runs, from another thread; one of the same name answers what is in line for it, and is gone when
  /// the call returns. Errors: as add; shutting_down.
  Status load(const std::string& name, std::shared_ptr<Engine> engine);
  /// Takes a policy away while the server runs, from another thread: returns when its acts are answered and its memory
  /// is free. Errors: bad_observation, usage, as Policies::remove; shutting_down.
  Status unload(const std::string& name);
  /// While it runs, from another thread. Errors: shutting_down.
  Result<std::vector<std::shared_ptr<ServedPolicy>>> policies();
  /// Tells the front ends which policy clients get that name none, and keeps it for them: the default, or the only one;
  /// once policies were added. Errors: usage where there is none of that, or where a front end cannot carry what it
  /// takes.
  Status begin();
  /// The front ends' notes on their names, for people; after `begin`.
  std::vector<std::string> told() const;

  /// Serves on this thread, which computes, and a second one, which talks, until `stop` or the loss of the
  /// device; then answers what waits and returns. Where policies are on a device of its own, a third thread prepares
  /// the next act meanwhile. Observers outlive the call. Once for each server, after `begin`. Errors: device,
  /// out_of_memory.
  Status run(std::span<Observer* const> observers = {});
  /// Keeps the sizes of acts that are computed; they outlive `run`.
  void keep_sizes(SeenSizes* sizes) { sizes_ = sizes; }
  /// The answer to `describe` once this engine is served under this name.
  v1::Description describe(const std::string& name, const Engine& engine) const;
  /// What chunks may be; none without --limits.
  const std::optional<control::Limits>& limits() const { return limits_; }
  /// From any thread or signal handler: what waits is refused.
  void stop() noexcept;
  /// From any thread: no act is taken any more, and those in line are answered before the server stops.
  void drain() noexcept;
  bool is_stopping() const noexcept { return state_.stopping; }
  /// From any thread.
  Health health() const { return state_.health(exchange_); }

 private:
  Server(const ServerOptions& options, Now now)
      : options_(options), policies_(options.default_policy), exchange_(limits_of(options), now), loop_(now) {}
  static Exchange::Jobs::Limits limits_of(const ServerOptions& options);

  /// An act on its way to its answer.
  struct Act {
    std::size_t place = 0;  // in ServedPolicy::encoded
    Answer answer;
    ActRequest request;
    StageClock clock;

    ServedPolicy& policy() const { return *answer.job.policy; }
    EncodedObservation& encoded() const { return policy().encoded[place]; }
  };
  /// False when no act comes any more.
  bool prepare_next(Act& act);
  void compute(Act& act);
  Status prepare(Act& act) const;
  Status respond(Act& act) const;
  void await_last_act(std::shared_ptr<ServedPolicy> policy) const;
  Result<std::shared_ptr<ServedPolicy>> served(const std::string& name, std::shared_ptr<Engine> engine) const;
  /// Runs `work` on the I/O thread. Errors: its own; shutting_down where that thread has ended.
  template <class Work>
  auto on_io_thread(Work work) -> decltype(work());
  template <class Work>
  static void attempt(Act& act, const Work& work) noexcept;

  ServerOptions options_;
  std::optional<control::Limits> limits_;
  std::span<Observer* const> observers_;
  bool records_ = false;  // one of them does
  SeenSizes* sizes_ = nullptr;
  Status lost_device_;
  mutable std::atomic<bool> saved_frames_ = false;  // of the first act
  Policies policies_;                               // of the I/O thread once it runs
  ServerState state_;
  Exchange exchange_;
  net::Loop loop_;
  Io::Fronts fronts_;
};

}  // namespace vla::serve
