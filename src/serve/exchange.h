// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <condition_variable>
#include <mutex>
#include <optional>

#include "serve/front.h"
#include "serve/queue.h"

namespace vla::serve {

/// A job with its answer.
struct Answer {
  Job job;
  std::string response;  // its bytes; empty where there is an error
  std::optional<Error> error;
  Clock::time_point started, finished;
  Timing stages;
  bool out_of_range = false;       // the state is beyond the bundle's bound
  int n_beyond = 0;                // rows of the chunk outside of --limits, also where it was refused for them
  std::vector<std::string> notes;  // of the chunk
  Record record;                   // of an act of another protocol, where one is kept
};

/// The meeting point of the I/O thread and those that compute: jobs one way, answers the other. None holds the lock for
/// longer than a move takes. `fd` announces what the I/O thread has to look at, which polls it together with its
/// sockets.
class Exchange {
 public:
  using Jobs = Queue<Job>;
  explicit Exchange(Jobs::Limits limits, Now now = Clock::now);
  ~Exchange();
  Exchange(const Exchange&) = delete;
  Exchange& operator=(const Exchange&) = delete;

  /// For one thread that takes jobs and one that answers them, or both in one; nothing here takes memory. `next` sleeps
  /// until there is a job that is not late, and returns none when the exchange is closed and empty. In a crowd it gives
  /// out one job at a time: one that is prepared ahead could not be overtaken by who comes from outside of the crowd.
  std::optional<Job> next();
  void put(Answer answer) noexcept;

  /// For the I/O thread.
  Jobs::Pushed push(Job job);
  std::optional<Answer> take_answer();
  std::optional<Job> take_late(Clock::time_point now);  // whose deadline passed while it waited
  std::optional<Job> take_waiting();                    // any job that waits
  std::optional<Clock::time_point> first_deadline() const;
  void close();          // no further jobs come
  bool drained() const;  // nothing waits, is computed, or is still to be answered

  /// For any thread; `wake` also for a signal handler.
  int fd() const { return fd_; }
  void wake() const noexcept;
  std::size_t n_waiting() const;
  bool computing() const;

 private:
  int fd_;  // an eventfd
  const Now now_;
  mutable std::mutex mutex_;
  std::condition_variable work_;
  Jobs jobs_;
  std::optional<Answer> answer_;  // the next one waits until it was taken
  int n_taken_ = 0;               // jobs that `next` gave out and `put` has not answered
  bool closed_ = false;
};

}  // namespace vla::serve
