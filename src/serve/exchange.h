// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <condition_variable>
#include <mutex>
#include <optional>
#include <vector>
#include <zmq.hpp>

#include "serve/envelope.h"
#include "serve/observer.h"
#include "serve/queue.h"

namespace vla::serve {

/// A request on its way through the server, with what is needed to answer it.
struct Job : Received {
  zmq::message_t route;    // routing id of the connection
  bool delimiter = false;  // the client put an empty frame before the request, as REQ sockets do
  zmq::message_t bytes;    // the serialized Request
  Envelope envelope;
  std::optional<Clock::time_point> deadline;

  std::span<const std::byte> request() const { return {bytes.data<std::byte>(), bytes.size()}; }
  std::span<const std::byte> body() const { return envelope.body(request()); }
};

/// A job with its answer.
struct Answer {
  Job job;
  zmq::message_t response;  // the serialized Response
  std::optional<Error> error;
  Clock::time_point started, finished;
  Timing stages;
};

/// Where the I/O thread and the engine thread meet: jobs one way, answers the other. Neither holds the lock for longer
/// than a move takes. What the I/O thread has to look at is announced by `fd`, which it polls together with its
/// sockets.
class Exchange {
 public:
  using Jobs = Queue<Job>;
  explicit Exchange(Jobs::Limits limits);
  ~Exchange();
  Exchange(const Exchange&) = delete;
  Exchange& operator=(const Exchange&) = delete;

  /// For the engine thread. `next` sleeps until there is a job, and returns none when the exchange is closed and empty.
  std::optional<Job> next();
  void put(Answer answer);

  /// For the I/O thread.
  Jobs::Pushed push(Job job);
  std::vector<Answer> take_answers();
  std::vector<Job> take_late();  // jobs whose deadline passed while they waited
  void close();                  // no further jobs come
  bool drained() const;          // nothing waits, is computed, or is still to be answered

  /// For any thread; `wake` also for a signal handler.
  int fd() const { return fd_; }
  void wake() const noexcept;
  std::size_t n_waiting() const;
  bool computing() const;

 private:
  void move_late(Clock::time_point now);

  int fd_;  // an eventfd
  mutable std::mutex mutex_;
  std::condition_variable work_;
  Jobs jobs_;
  std::vector<Answer> answers_;
  std::vector<Job> late_;
  bool computing_ = false, closed_ = false;
};

}  // namespace vla::serve
