// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <atomic>
#include <exception>
#include <memory>
#include <span>
#include <vector>

#include "net/loop.h"
#include "serve/exchange.h"
#include "serve/policies.h"

namespace vla::serve {

/// The state that both threads and every observer may read.
struct ServerState {
  std::atomic<bool> ready = false, stopping = false;
  std::atomic<bool> draining = false;     // no act comes in line any more; it stops when the line is empty
  std::atomic<bool> device_lost = false;  // acts that wait get the device's error
  std::atomic<bool> ended = false;        // the I/O thread has
  std::atomic<std::uint64_t> n_chunk = 0, n_error = 0;
  std::atomic<Clock::rep> ready_since = 0;

  void begin() noexcept;
  Health health(const Exchange& exchange) const;
};

/// The I/O thread, on which the front ends receive requests, answer at once what needs no engine, and put acts in line;
/// it sends what comes back. It never computes, so that no client waits for it while another one's act runs.
class Io {
 public:
  using Fronts = std::vector<std::unique_ptr<Front>>;
  /// Everything outlives the thread.
  Io(net::Loop& loop, const Fronts& fronts, Exchange& exchange, Policies& policies, ServerState& state,
     std::span<Observer* const> observers);

  /// Until the server is stopped, what is computed is answered, and what waits is refused.
  void run();

  /// For the front ends. A request that came; then one of the next three, which answers it exactly once. The job is
  /// lost where they throw for lack of memory.
  void received(const Received& request);
  /// Puts an act in line, whose `deadline_ms` is checked.
  void submit(Job job);
  void answer(Job job, std::string response);
  /// Makes the error only where the memory for it may be lacking.
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
  void count_error() noexcept { ++state_.n_error; }  // of a request that was refused without a job
  void stop() noexcept;                              // as Server::stop
  Clock::time_point now() const { return loop_.now(); }
  /// The description of a policy by its name, as Policies::find, with the names of all.
  Result<v1::Description> describe(const std::string& policy) const;
  Health health() const { return state_.health(exchange_); }

 private:
  void send_answer(Answer& answer) noexcept;
  void send_without_memory(Answer& answer) noexcept;
  void deliver(Answer& answer);
  void deliver_waiting();
  void refuse_waiting();
  void wait(std::optional<Clock::time_point> until);
  bool has_answers() const;

  net::Loop& loop_;
  const Fronts& fronts_;
  Exchange& exchange_;
  Policies& policies_;
  ServerState& state_;
  std::span<Observer* const> observers_;
};

}  // namespace vla::serve
