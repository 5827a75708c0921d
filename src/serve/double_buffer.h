// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <condition_variable>
#include <cstdint>
#include <mutex>
#include <utility>

namespace vla::serve {

/// Two acts in alternation: one thread prepares one of them while another computes the other.
template <class Act>
class DoubleBuffer {
 public:
  explicit DoubleBuffer(std::array<Act, 2> acts = {}) : acts_(std::move(acts)) {}

  /// Waits for a free act to prepare; `prepared` hands it over.
  Act& to_prepare() {
    std::unique_lock lock(mutex_);
    changed_.wait(lock, [this] { return n_prepared_ - n_computed_ < acts_.size(); });
    return acts_[n_prepared_ % acts_.size()];
  }
  void prepared() { count(n_prepared_); }
  /// Ends the exchange: no act is prepared afterwards.
  void close() {
    const std::lock_guard lock(mutex_);
    closed_ = true;
    changed_.notify_all();
  }

  /// Waits for a prepared act to compute; `computed` returns it. Null after the end.
  Act* to_compute() {
    std::unique_lock lock(mutex_);
    changed_.wait(lock, [this] { return n_prepared_ > n_computed_ || closed_; });
    return n_prepared_ > n_computed_ ? &acts_[n_computed_ % acts_.size()] : nullptr;
  }
  void computed() { count(n_computed_); }

 private:
  void count(std::uint64_t& n) {
    const std::lock_guard lock(mutex_);
    ++n;
    changed_.notify_all();
  }

  std::mutex mutex_;
  std::condition_variable changed_;
  std::array<Act, 2> acts_;
  std::uint64_t n_prepared_ = 0, n_computed_ = 0;
  bool closed_ = false;
};

}  // namespace vla::serve
