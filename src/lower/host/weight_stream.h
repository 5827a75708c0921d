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

/// Streams matrices that have no memory of their own. While programs compute, threads read groups of matrices from the
/// bundle's file, check and pack them, cyclically. The next groups are ready in windows, and a group always uses the
/// same window. So a matrix has a fixed address, but programs must call `bring` before they read it.
class WeightStream {
 public:
  /// One window in use, one ready, one being filled.
  static constexpr int kWindows = 3;
  static int window_of(std::size_t group) { return static_cast<int>(group) % kWindows; }

  /// groups: the parts of each group, which are read into the group's window. Errors: out_of_memory if the system
  /// refuses a thread.
  static Result<std::unique_ptr<WeightStream>> start(std::shared_ptr<const Content> content,
                                                     std::vector<std::vector<PackPart>> groups, int n_thread);
  WeightStream(const WeightStream&) = delete;
  WeightStream& operator=(const WeightStream&) = delete;
  ~WeightStream();

  /// Waits until groups `first` to `last`, at most kWindows, are in memory. They stay until `release` or until other
  /// groups are requested. Request groups in their order for speed. Errors: bad_bundle if the file no longer has their
  /// bytes; the next request reads them again.
  Status bring(int first, int last);
  /// Releases a group and those before it; later groups take their windows.
  void release(int group);

 private:
  using Lock = std::unique_lock<std::mutex>;
  /// Counts groups over rounds: turn r * n_group + g is group g of round r.
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
  Turn oldest_ = 0;                    // the first turn whose window is in use
  Turn reading_ = 0;                   // the turn whose parts are handed out
  std::size_t next_part_ = 0;          // index of the next part of that turn
  std::size_t n_left_[kWindows] = {};  // parts of this window's turn that are not in memory yet
  int n_busy_ = 0;                     // threads that are reading a part
  bool has_failed_ = false, moves_ = false, stop_ = false;
};

}  // namespace vla::lower
