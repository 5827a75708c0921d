// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <condition_variable>
#include <cstdint>
#include <memory>
#include <mutex>
#include <thread>
#include <vector>

#include "lower/host/packing.h"

namespace vla::lower {

/// Matrices that have no place of their own in memory. Threads read them from the bundle's file, check and pack them,
/// group after group and round and round, while programs compute: the groups after the one that is needed stand in
/// windows, each group always in the same one. So programs find every matrix at an address that never changes, and have
/// to say when they need it.
class WeightStream {
 public:
  /// One that is read, one that is ready and one that is filled.
  static constexpr int kWindows = 3;
  static int window_of(std::size_t group) { return static_cast<int>(group) % kWindows; }

  /// groups: the parts of each, which go to the group's window. Errors: out_of_memory where the system refuses a
  /// thread.
  static Result<std::unique_ptr<WeightStream>> start(std::shared_ptr<const Content> content,
                                                     std::vector<std::vector<PackPart>> groups, int n_thread);
  WeightStream(const WeightStream&) = delete;
  WeightStream& operator=(const WeightStream&) = delete;
  ~WeightStream();

  /// Waits until groups `first` to `last`, at most kWindows, are in memory. They stay there until `release` or until
  /// others are wanted. Groups are best wanted in their order. Errors: bad_bundle where the file has not their bytes
  /// any more; whoever asks next has them read again.
  Status bring(int first, int last);
  /// The group is needed no more in this run: one behind it takes its window.
  void release(int group);

 private:
  using Lock = std::unique_lock<std::mutex>;
  /// A group in one of the rounds: of round r group g is r * n_group + g.
  using Turn = std::uint64_t;

  WeightStream(std::shared_ptr<const Content> content, std::vector<std::vector<PackPart>> groups);
  void serve(Packer packer);
  bool has_part();
  const PackPart& take_part();
  std::size_t& n_left(Turn turn) { return n_left_[turn % kWindows]; }
  std::size_t n_left(Turn turn) const { return n_left_[turn % kWindows]; }
  const std::vector<PackPart>& parts(Turn turn) const { return groups_[turn % groups_.size()]; }
  Turn turn_of(int group) const;
  bool are_loaded(Turn begin, Turn end) const;
  void go_to(Turn turn, Lock& lock);

  const std::shared_ptr<const Content> content_;
  std::vector<std::vector<PackPart>> groups_;
  std::vector<std::thread> threads_;

  std::mutex mutex_;
  std::condition_variable may_read_, has_read_;
  Turn oldest_ = 0;                    // the first whose window is not free
  Turn reading_ = 0;                   // whose parts are handed out
  std::size_t next_part_ = 0;          // of them
  std::size_t n_left_[kWindows] = {};  // parts of the turn in this window that are not in memory yet
  int n_busy_ = 0;                     // threads that have a part
  bool has_failed_ = false, moves_ = false, stop_ = false;
};

}  // namespace vla::lower
