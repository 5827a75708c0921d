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
  std::string response;  // serialized; empty if there is an error
  std::optional<Error> error;
  Clock::time_point started, finished;
  Timing stages;
  bool out_of_range = false;       // the state is beyond the bundle's bound
  int n_beyond = 0;                // rows of the chunk beyond --limits, also if the chunk was refused for them
  std::vector<std::string> notes;  // the chunk's notes
  Record record;                   // native messages of an act of another protocol, if an observer records
};

/// Passes jobs from the I/O thread to the preparing and computing threads, and answers back. No thread holds the lock
/// for longer than a move takes. `fd` becomes readable when there is something for the I/O thread, which polls it
/// together with its sockets.
class Exchange {
 public:
  using Jobs = Queue<Job>;
  explicit Exchange(Jobs::Limits limits, Now now = Clock::now);
  ~Exchange();
  Exchange(const Exchange&) = delete;
  Exchange& operator=(const Exchange&) = delete;

  /// For one thread that takes jobs and one that answers them, or one thread for both. Neither function allocates
  /// memory, except `next` in a crowd. `next` blocks until a job that is not late waits, and returns none once the
  /// exchange is closed and empty. In a crowd (Queue::is_crowded) it hands out a job only after the previous one is
  /// answered: a job from another peer could not overtake one that is prepared ahead.
  std::optional<Job> next();
  void put(Answer answer) noexcept;

  /// For the I/O thread.
  Jobs::Pushed push(Job job);
  std::optional<Answer> take_answer();
  std::optional<Job> take_late(Clock::time_point now);  // a job whose deadline passed while it waited
  std::optional<Job> take_waiting();                    // the next waiting job, late or not
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
  std::optional<Answer> answer_;  // `put` waits until the previous answer is taken
  int n_taken_ = 0;               // jobs that `next` gave out and `put` has not answered
  bool closed_ = false;
};

}  // namespace vla::serve
