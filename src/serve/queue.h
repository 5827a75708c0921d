// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <list>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "serve/observer.h"

namespace vla::serve {

/// The acts that wait for the engine: at most one for each client, the newest.
///
/// Clients stand in line in the order in which they began to wait. A newer act of a client takes the place of its older
/// one, in the same spot, and a client that was served goes to the end when it comes again: with one place each that is
/// round robin. Neither a client that sends faster than others nor one that opens with a burst gets more turns.
///
/// `Job` has `client` (std::string), `deadline` (std::optional<Clock::time_point>) and `size` (bytes). The queue knows
/// no clock and takes no lock.
template <class Job>
class Queue {
 public:
  struct Limits {
    std::size_t jobs, bytes;
  };
  explicit Queue(Limits limits) : limits_(limits) {}

  std::size_t size() const { return line_.size(); }
  bool empty() const { return line_.empty(); }

  /// Puts a job in line. The one that does not wait afterwards, if any, comes back: `superseded` the older job of the
  /// same client, or `refused` the given one, where the queue is full.
  struct Pushed {
    std::optional<Job> superseded, refused;
  };
  Pushed push(Job job) {
    Pushed result;
    const auto older = std::find_if(line_.begin(), line_.end(), [&](const Job& j) { return j.client == job.client; });
    const std::size_t freed = older == line_.end() ? 0 : older->size;
    if ((older == line_.end() && line_.size() >= limits_.jobs) || bytes_ - freed + job.size > limits_.bytes) {
      result.refused = std::move(job);
      return result;
    }
    bytes_ += job.size - freed;
    if (older == line_.end()) {
      line_.push_back(std::move(job));
    } else {
      result.superseded = std::exchange(*older, std::move(job));
    }
    return result;
  }

  /// Takes the jobs out whose deadline is not after `now`.
  std::vector<Job> take_late(Clock::time_point now) {
    std::vector<Job> late;
    for (auto job = line_.begin(); job != line_.end();) {
      const auto next = std::next(job);
      if (job->deadline && *job->deadline <= now) late.push_back(take(job));
      job = next;
    }
    return late;
  }

  /// The client that waits longest.
  std::optional<Job> pop() {
    if (line_.empty()) return std::nullopt;
    return take(line_.begin());
  }

 private:
  Job take(typename std::list<Job>::iterator at) {
    Job job = std::move(*at);
    bytes_ -= job.size;
    line_.erase(at);
    return job;
  }

  Limits limits_;
  std::list<Job> line_;  // of at most as many clients as fit: a search by name costs nothing beside one act
  std::size_t bytes_ = 0;
};

}  // namespace vla::serve
