// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <list>
#include <map>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "observe/observer.h"

namespace vla::serve {

/// The acts that wait for the engine: at most one for each client, the newest.
///
/// Peers take turns, and the clients of a peer take turns at its turns, in the order in which they began to wait: a
/// peer is one key or one address, a client one connection of it. A newer act of a client takes the place of its older
/// one. So neither a client that sends faster than others nor a peer that opens many connections gets more turns. Where
/// the queue is full, the peer that has most in it gives way to one that has less.
///
/// `Job` has `client` and `peer` (std::string), `deadline` (std::optional<Clock::time_point>) and `size` (bytes). The
/// queue knows no clock and takes no lock.
template <class Job>
class Queue {
 public:
  struct Limits {
    std::size_t jobs, bytes;
  };
  explicit Queue(Limits limits) : limits_(limits) {}

  std::size_t size() const { return line_.size(); }
  bool empty() const { return line_.empty(); }

  /// Puts a job in line. Those that do not wait afterwards come back: `superseded` the older job of the same client,
  /// `refused` the given one or the last ones of a peer that has more in line.
  struct Pushed {
    std::optional<Job> superseded;
    std::vector<Job> refused;
  };
  Pushed push(Job job) {
    Pushed result;
    const auto older = find([&](const Job& j) { return j.client == job.client; });
    const std::size_t n_new = older == line_.end() ? 1 : 0, freed = older == line_.end() ? 0 : older->size;
    while (line_.size() + n_new > limits_.jobs || bytes_ - freed + job.size > limits_.bytes) {
      const auto last = line_.size() + n_new > limits_.jobs
                            ? last_of_others(
                                  job.peer, [](const Job&) { return 1; }, n_new)
                            : last_of_others(
                                  job.peer, [](const Job& j) { return j.size; }, job.size - std::min(freed, job.size));
      if (last == line_.end()) {
        result.refused.push_back(std::move(job));
        return result;
      }
      result.refused.reserve(result.refused.size() + 1);  // before it is taken out of the line
      result.refused.push_back(take(last));
    }
    if (older == line_.end()) {
      wait(std::move(job));
    } else {
      bytes_ += job.size - freed;
      result.superseded = std::exchange(*older, std::move(job));
    }
    return result;
  }

  /// Takes a job out whose deadline is not after `now`.
  std::optional<Job> take_late(Clock::time_point now) {
    const auto late = find([&](const Job& job) { return job.deadline && *job.deadline <= now; });
    return late == line_.end() ? std::nullopt : std::optional<Job>(take(late));
  }

  /// When `take_late` has something to take, if nothing changes before.
  std::optional<Clock::time_point> first_deadline() const {
    std::optional<Clock::time_point> first;
    for (const Job& job : line_)
      if (job.deadline && (!first || *job.deadline < *first)) first = job.deadline;
    return first;
  }

  /// The client that waits longest, of the peer whose turn it is.
  std::optional<Job> pop() {
    if (line_.empty()) return std::nullopt;
    turns_.splice(turns_.end(), turns_, turns_.begin());
    return take(find([&](const Job& job) { return job.peer == turns_.back(); }));
  }

 private:
  using Place = typename std::list<Job>::iterator;

  template <class Wanted>
  Place find(Wanted wanted) {
    return std::find_if(line_.begin(), line_.end(), wanted);
  }

  /// Takes all memory before it changes anything: where there is none, the queue stays as it was.
  void wait(Job job) {
    const bool has_turn = std::find(turns_.begin(), turns_.end(), job.peer) != turns_.end();
    std::list<std::string> turn(has_turn ? 0 : 1, job.peer);
    std::list<Job> last;
    last.push_back(std::move(job));
    bytes_ += last.back().size;
    turns_.splice(turns_.end(), turn);
    line_.splice(line_.end(), last);
  }

  /// The last job of the peer whose jobs amount to most, where that is more than `peer` would have with `added`.
  template <class Amount>
  Place last_of_others(const std::string& peer, Amount amount, std::size_t added) {
    std::map<std::string, std::size_t> sums;
    for (const Job& job : line_) sums[job.peer] += static_cast<std::size_t>(amount(job));
    const std::size_t own = sums[peer] + added;
    const auto most = std::max_element(sums.begin(), sums.end(), [](auto& a, auto& b) { return a.second < b.second; });
    if (most->first == peer || most->second <= own) return line_.end();
    const auto last =
        std::find_if(line_.rbegin(), line_.rend(), [&](const Job& job) { return job.peer == most->first; });
    return std::prev(last.base());
  }

  Job take(Place at) {
    Job job = std::move(*at);
    bytes_ -= job.size;
    line_.erase(at);
    if (find([&](const Job& other) { return other.peer == job.peer; }) == line_.end()) turns_.remove(job.peer);
    return job;
  }

  Limits limits_;
  std::list<Job> line_;           // of at most as many clients as fit: a search by name costs nothing beside one act
  std::list<std::string> turns_;  // the peers that have a job in line, the next one first
  std::size_t bytes_ = 0;
};

}  // namespace vla::serve
