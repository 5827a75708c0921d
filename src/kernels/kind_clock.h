// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <atomic>
#include <chrono>
#include <cstdint>

namespace vla::kernels {

/// Counts the time of operations by kind while it is on: two clock readings per item.
struct KindClock {
  enum Kind { products, attention, norms, others, count };
  static constexpr const char* kNames[] = {"products", "attention", "norms and codes", "others"};

  void add(Kind kind, std::chrono::nanoseconds time) {
    nanoseconds[kind].fetch_add(time.count(), std::memory_order_relaxed);
  }

  std::atomic<bool> runs = false;
  std::array<std::atomic<std::int64_t>, count> nanoseconds = {};  // summed over threads
};

}  // namespace vla::kernels
