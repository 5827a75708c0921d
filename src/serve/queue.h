// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <array>
#include <functional>
#include <list>
#include <map>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "base/clock.h"
#include "serve/generations.h"

namespace vla::serve {

/// The acts that wait for the engine: at most one for each client, the newest.
///
/// Peers take turns, and the clients of a peer take turns at its turns, in the order in which they began to wait: a
/// peer is one key or one address, a client one connection of it. A newer act of a client takes the place of its older
/// one. So neither a client that sends faster than others nor a peer that opens many connections gets more turns. If
/// more than `kCrowd` clients of one peer wait, for example because a program floods the server from the robot's own
/// machine, generations take turns first. A generation is a group of connections that arrived together; a generation of
/// a hundred connections gets as many turns as a generation of one. If the queue is full, the peer with most in it
/// gives way to a peer with less; within a peer, the generation with most gives way.
///
/// A peer (in a crowd, a generation) goes first if it connected earlier and had fewer of the last `kRecent` turns. So
/// robots that connected before a flood, and ask for less than half of what the server computes, wait only for the act
/// in progress. Later connections never go first, and nobody waits more than `kRecent` turns beyond its place in line.
///
/// `Job` has `client` (std::string), `share` (net::Share), `deadline` (std::optional<Clock::time_point>) and `size`
/// (bytes). The queue knows no clock and takes no lock.
template <class Job>
class Queue {
 public:
  struct Limits {
    std::size_t jobs, bytes;
  };
  static constexpr std::size_t kCrowd = 8;
  static constexpr std::size_t kRecent = 64;
  explicit Queue(Limits limits) : limits_(limits) {}

  std::size_t size() const { return line_.size(); }
  bool empty() const { return line_.empty(); }
  /// Whether more than `kCrowd` clients of the next peer wait.
  bool is_crowded() const { return !turns_.empty() && n_of(next_peer()->group) > kCrowd; }

  /// Queues a job. Jobs that do not wait afterwards are returned: `superseded` is the client's older job, `refused` the
  /// given job or the last ones of a peer that has more in the queue.
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
                            ? to_give_way(
                                  job, [](const Job&) { return std::size_t{1}; }, n_new)
                            : to_give_way(
                                  job, [](const Job& j) { return j.size; }, job.size - std::min(freed, job.size));
      if (last == line_.end()) {
        result.refused.push_back(std::move(job));
        return result;
      }
      result.refused.reserve(result.refused.size() + 1);  // allocates before the job leaves the queue
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

  /// Removes a job whose deadline is at or before `now`.
  std::optional<Job> take_late(Clock::time_point now) {
    const auto late = find([&](const Job& job) { return job.deadline && *job.deadline <= now; });
    return late == line_.end() ? std::nullopt : std::optional<Job>(take(late));
  }

  /// Returns the earliest deadline of the waiting jobs.
  std::optional<Clock::time_point> first_deadline() const {
    std::optional<Clock::time_point> first;
    for (const Job& job : line_)
      if (job.deadline && (!first || *job.deadline < *first)) first = job.deadline;
    return first;
  }

  /// Removes the next job of the peer whose turn it is: that of the client that waits longest, or in a crowd that of
  /// the next generation.
  std::optional<Job> pop() {
    if (line_.empty()) return std::nullopt;
    turns_.splice(turns_.end(), turns_, next_peer());
    Turn& turn = turns_.back();
    const bool is_crowd = n_of(turn.group) > kCrowd;
    const Place next =
        is_crowd ? next_generation(turn) : find([&](const Job& job) { return job.share.group == turn.group; });
    recent_[n_popped_++ % kRecent] = {hash_of(turn.group), next->share.since};
    return take(next);
  }

 private:
  using Place = typename std::list<Job>::iterator;
  struct Turn {
    std::string group;
    Clock::time_point last = {};  // in a crowd: arrival of the connection that had the group's last turn
  };

  /// A past turn. It holds a hash of the group, which needs no allocation.
  struct Recent {
    std::size_t group = 0;
    Clock::time_point since = {};
  };

  static std::size_t hash_of(const std::string& group) { return std::hash<std::string>()(group); }

  /// How many of the last turns a group had.
  std::size_t n_recent_of(const std::string& group) const {
    return static_cast<std::size_t>(std::count_if(
        recent_.begin(), recent_.end(), [hash = hash_of(group)](const Recent& turn) { return turn.group == hash; }));
  }

  /// Returns when the oldest of the group's waiting connections arrived.
  Clock::time_point oldest_of(const std::string& group) const {
    Clock::time_point oldest = Clock::time_point::max();
    for (const Job& job : line_)
      if (job.share.group == group) oldest = std::min(oldest, job.share.since);
    return oldest;
  }

  /// Returns the first peer in line, or one that connected earlier and had fewer of the recent turns.
  typename std::list<Turn>::const_iterator next_peer() const {
    auto next = turns_.begin();
    for (auto turn = std::next(next); turn != turns_.end(); ++turn)
      if (oldest_of(turn->group) < oldest_of(next->group) && n_recent_of(turn->group) < n_recent_of(next->group))
        next = turn;
    return next;
  }

  template <class Wanted>
  Place find(Wanted wanted) {
    return std::find_if(line_.begin(), line_.end(), wanted);
  }

  /// Allocates before it changes anything, so the queue is unchanged if memory runs out.
  void wait(Job job) {
    std::list<Turn> turn;
    if (n_of(job.share.group) == 0) turn.push_back({job.share.group});
    std::list<Job> last;
    last.push_back(std::move(job));
    bytes_ += last.back().size;
    turns_.splice(turns_.end(), turn);
    line_.splice(line_.end(), last);
  }

  std::size_t n_of(const std::string& group) const {
    return static_cast<std::size_t>(
        std::count_if(line_.begin(), line_.end(), [&](const Job& job) { return job.share.group == group; }));
  }

  /// Returns the generations that the group's waiting clients and the given times of arrival form.
  Generations generations_of(const std::string& group, std::vector<Clock::time_point> times = {}) const {
    for (const Job& job : line_)
      if (job.share.group == group) times.push_back(job.share.since);
    return Generations(std::move(times));
  }

  /// In a crowd: returns the group's first job of the next older generation after the one that had the last turn; the
  /// newest follows the oldest. Later arrivals are newer and delay nobody. An older generation that had fewer of the
  /// recent turns comes first.
  Place next_generation(Turn& turn) {
    const Generations generations = generations_of(turn.group, {turn.last});  // that connection may have left the queue
    const auto distance = [&](const Job& job) {
      const std::size_t n = generations.size();
      return job.share.group == turn.group ? (generations.of(turn.last) + n - generations.of(job.share.since) - 1) % n
                                           : n;
    };
    auto next = std::min_element(line_.begin(), line_.end(),
                                 [&](const Job& a, const Job& b) { return distance(a) < distance(b); });
    std::vector<std::size_t> n_turn(generations.size());
    for (const Recent& had : recent_)
      if (had.group == hash_of(turn.group)) ++n_turn[generations.of(had.since)];
    for (auto job = line_.begin(); job != line_.end(); ++job) {
      const std::size_t own = generations.of(job->share.since), other = generations.of(next->share.since);
      if (job->share.group == turn.group && own < other && n_turn[own] < n_turn[other]) next = job;
    }
    turn.last = next->share.since;
    return next;
  }

  /// Returns the job that must leave so that the given one fits; none if that would be unfair. `added`: what the given
  /// job adds to its peer's sum of `amount`.
  template <class Amount>
  Place to_give_way(const Job& job, Amount amount, std::size_t added) {
    std::map<std::string, std::size_t> sums = {{job.share.group, added}};
    for (const Job& j : line_) sums[j.share.group] += amount(j);
    const auto most = std::max_element(sums.begin(), sums.end(), [](auto& a, auto& b) { return a.second < b.second; });
    if (most->second > sums[job.share.group]) return last_of_largest_generation(most->first, amount);
    return last_of_largest_generation(job.share.group, amount, &job, added);
  }

  /// Returns the last job of the group's largest generation, the newest generation if several are equal. None if the
  /// newcomer's own generation would be as large.
  template <class Amount>
  Place last_of_largest_generation(const std::string& group, Amount amount, const Job* newcomer = nullptr,
                                   std::size_t added = 0) {
    std::vector<Clock::time_point> times;
    if (newcomer != nullptr) times.push_back(newcomer->share.since);
    const Generations generations = generations_of(group, std::move(times));
    std::vector<std::size_t> sums(generations.size());
    for (const Job& job : line_)
      if (job.share.group == group) sums[generations.of(job.share.since)] += amount(job);
    const auto largest = std::max_element(sums.rbegin(), sums.rend());
    if (newcomer != nullptr && *largest <= sums[generations.of(newcomer->share.since)] + added) return line_.end();
    const auto generation = static_cast<std::size_t>(sums.rend() - largest) - 1;
    const auto last = std::find_if(line_.rbegin(), line_.rend(), [&](const Job& job) {
      return job.share.group == group && generations.of(job.share.since) == generation;
    });
    return std::prev(last.base());
  }

  Job take(Place at) {
    Job job = std::move(*at);
    bytes_ -= job.size;
    line_.erase(at);
    if (n_of(job.share.group) == 0) turns_.remove_if([&](const Turn& turn) { return turn.group == job.share.group; });
    return job;
  }

  Limits limits_;
  std::list<Job> line_;    // at most Limits::jobs: a linear search costs nothing beside an act
  std::list<Turn> turns_;  // peers with a queued job, the next one first
  std::size_t bytes_ = 0;
  std::array<Recent, kRecent> recent_;  // the last turns, in a ring
  std::size_t n_popped_ = 0;
};

}  // namespace vla::serve
