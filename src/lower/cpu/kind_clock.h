// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <atomic>
#include <chrono>
#include <memory>

#include "kernels/executor.h"

namespace vla::lower {

/// What operations take by kind, while somebody wants to know: two readings of the clock for each item.
struct KindClock {
  enum Kind { products, attention, norms, others, count };
  static constexpr const char* kNames[] = {"products", "attention", "norms and codes", "others"};

  std::atomic<bool> runs = false;
  std::array<std::atomic<std::int64_t>, count> nanoseconds = {};  // of all threads together
};

/// A task whose time counts for a kind.
class TimedTask final : public kernels::Task {
 public:
  TimedTask(std::unique_ptr<kernels::Task> task, KindClock::Kind kind, std::shared_ptr<KindClock> clock)
      : task_(std::move(task)), kind_(kind), clock_(std::move(clock)) {
    n_item = task_->n_item;
  }

  void run(std::int64_t item, kernels::Worker& worker) const override {
    if (!clock_->runs.load(std::memory_order_relaxed)) return task_->run(item, worker);
    const auto start = std::chrono::steady_clock::now();
    task_->run(item, worker);
    const std::chrono::nanoseconds time = std::chrono::steady_clock::now() - start;
    clock_->nanoseconds[kind_].fetch_add(time.count(), std::memory_order_relaxed);
  }

 private:
  const std::unique_ptr<kernels::Task> task_;
  const KindClock::Kind kind_;
  const std::shared_ptr<KindClock> clock_;
};

}  // namespace vla::lower
