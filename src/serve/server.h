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
#include "serve/options.h"
#include "serve/seen_sizes.h"

namespace vla::serve {

/// Serves policies in memory over the sockets of the front ends. It keeps no state between requests.
class Server {
 public:
  /// Binds the addresses. Requests that arrive before `run` wait. Errors: usage (an invalid address or key; an address
  /// that other machines can reach, without keys), io (an address in use or not of this machine; no file descriptors).
  static Result<std::unique_ptr<Server>> open(const ServerOptions& options, Now now = Clock::now);

  /// The bound addresses, ports filled in.
  std::vector<std::string> addresses() const;
  /// The limit for each protocol; lower than requested if the system gives this process few file descriptors.
  std::size_t max_connections() const { return options_.max_connections; }

  /// Adds a policy that acts may name; call it before `run`. Errors: incompatible, as Policies::put; usage if --limits
  /// do not fit its actions.
  Status add(const std::string& name, std::shared_ptr<Engine> engine);
  /// Adds a policy while the server runs, from another thread. A policy of the same name still answers its waiting
  /// acts, and is gone when the call returns. Errors: as add; shutting_down.
  Status load(const std::string& name, std::shared_ptr<Engine> engine);
  /// Removes a policy while the server runs, from another thread; returns when its acts are answered and its memory is
  /// free. Errors: bad_observation, usage, as Policies::remove; shutting_down.
  Status unload(const std::string& name);
  /// Returns the policies while the server runs, from another thread. Errors: shutting_down.
  Result<std::vector<std::shared_ptr<ServedPolicy>>> policies();
  /// Sets the policy for clients that name none: the default or the only one, whatever is loaded later. Call it after
  /// `add`. Errors: usage if a front end needs such a policy and there is none, or cannot carry its inputs.
  Status begin();
  /// The front ends' notes on their names, for people; after `begin`.
  std::vector<std::string> told() const;

  /// Serves until `stop`, the end of `drain`, or the loss of the device; then ends every waiting act with an answer or
  /// a refusal and returns. This thread computes and a second one does the I/O; unless the policies run on the host, a
  /// third one prepares the next act meanwhile. Observers must outlive the call. Call it once for each server, after
  /// `begin`. Errors: device, out_of_memory.
  Status run(std::span<Observer* const> observers = {});
  /// Adds the sizes of computed acts to `sizes`, which must outlive `run`.
  void keep_sizes(SeenSizes* sizes) { sizes_ = sizes; }
  /// The answer to `describe` once this engine is served under this name.
  v1::Description describe(const std::string& name, const Engine& engine) const;
  /// The limits for chunks; none without --limits.
  const std::optional<control::Limits>& limits() const { return limits_; }
  /// Stops the server; waiting acts are refused. Any thread or signal handler may call it.
  void stop() noexcept;
  /// Accepts no more acts, and stops the server once the waiting acts are answered. Any thread may call it.
  void drain() noexcept;
  bool is_stopping() const noexcept { return state_.stopping; }
  /// Any thread may call it.
  Health health() const { return state_.health(exchange_); }

 private:
  Server(const ServerOptions& options, Now now)
      : options_(options), policies_(options.default_policy), exchange_(limits_of(options), now), loop_(now) {}
  static Exchange::Jobs::Limits limits_of(const ServerOptions& options);

  /// An act on its way to its answer.
  struct Act {
    std::size_t place = 0;  // index in ServedPolicy::encoded
    Answer answer;
    ActRequest request;
    StageClock clock;

    ServedPolicy& policy() const { return *answer.job.policy; }
    EncodedObservation& encoded() const { return policy().encoded[place]; }
  };
  /// Returns false when no more acts come.
  bool prepare_next(Act& act);
  void compute(Act& act);
  Status prepare(Act& act) const;
  Status respond(Act& act) const;
  void await_last_act(std::shared_ptr<ServedPolicy> policy) const;
  Result<std::shared_ptr<ServedPolicy>> served(const std::string& name, std::shared_ptr<Engine> engine) const;
  /// Runs `work` on the I/O thread. Errors: those of `work`; shutting_down if that thread has ended.
  template <class Work>
  auto on_io_thread(Work work) -> decltype(work());
  template <class Work>
  static void attempt(Act& act, const Work& work) noexcept;

  ServerOptions options_;
  std::optional<control::Limits> limits_;
  std::span<Observer* const> observers_;
  bool records_ = false;  // whether an observer records
  SeenSizes* sizes_ = nullptr;
  Status lost_device_;
  mutable std::atomic<bool> saved_frames_ = false;  // whether the first act's frames are saved
  Policies policies_;                               // only for the I/O thread once it runs
  ServerState state_;
  Exchange exchange_;
  net::Loop loop_;
  Io::Fronts fronts_;
};

}  // namespace vla::serve
