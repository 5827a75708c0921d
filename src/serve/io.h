// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <atomic>
#include <exception>
#include <memory>
#include <span>
#include <vector>

#include "net/loop.h"
#include "net/sweeper.h"
#include "serve/exchange.h"
#include "serve/policies.h"

namespace vla::serve {

/// State that all threads may read.
struct ServerState {
  std::atomic<bool> ready = false, stopping = false;
  // draining: no act is queued any more, and the server stops when the queue is empty
  std::atomic<bool> draining = false;
  std::atomic<bool> device_lost = false;  // waiting acts are answered with the device's error
  std::atomic<bool> ended = false;        // the I/O thread has stopped
  std::atomic<std::uint64_t> n_chunk = 0, n_error = 0;
  std::atomic<Clock::rep> ready_since = 0;

  void begin() noexcept;
  Health health(const Exchange& exchange) const;
};

/// The I/O thread. Front ends receive requests on it, answer at once what needs no engine, and queue acts; it sends the
/// answers. It never computes, so no client waits for it while another one's act runs.
class Io {
 public:
  using Fronts = std::vector<std::unique_ptr<Front>>;
  /// All arguments must outlive the thread.
  Io(net::Loop& loop, const Fronts& fronts, Exchange& exchange, Policies& policies, ServerState& state,
     std::span<Observer* const> observers);

  /// Runs until the server is stopped. Computed acts are answered then, waiting ones refused.
  void run();

  /// For front ends: reports a received request. The front end must then call exactly one of `submit`, `answer` and
  /// `refuse`, which answers the request once. If that call throws for lack of memory, the job is lost.
  void received(const Received& request);
  /// Queues an act and checks its `deadline_ms`.
  void submit(Job job);
  void answer(Job job, std::string response);
  /// Refuses a request; the error is created only if there may be memory for it.
  template <class MakeError>
  void refuse(Job job, MakeError error) noexcept {
    Answer answer;
    answer.started = answer.finished = job.at;
    answer.job = std::move(job);
    try {
      answer.error = error();
    } catch (const std::exception&) {
      return send_without_memory(answer);
    }
    send_answer(answer);
  }
  void dropped(const Dropped& connection);
  void count_error() noexcept { ++state_.n_error; }  // for a request that was refused without a job
  void stop() noexcept;                              // see Server::stop
  Clock::time_point now() const { return loop_.now(); }
  /// The description of a policy by name (Policies::find), with the names of all policies.
  Result<v1::Description> describe(const std::string& policy) const;
  Health health() const { return state_.health(exchange_); }

 private:
  void send_answer(Answer& answer) noexcept;
  void send_without_memory(Answer& answer) noexcept;
  void deliver(Answer& answer);
  void deliver_waiting();
  void refuse_waiting();
  void wait(std::optional<Clock::time_point> until);
  void sweep();
  bool has_answers() const;

  net::Loop& loop_;
  const Fronts& fronts_;
  Exchange& exchange_;
  Policies& policies_;
  ServerState& state_;
  std::span<Observer* const> observers_;
  net::Sweeper sweeper_{loop_};
  int n_sweep_ = 0;
};

}  // namespace vla::serve
