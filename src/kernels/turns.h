// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

namespace vla::kernels {

/// Who does which part of a node's work. Every thread has a stretch of its own, whose operands stay in its caches; who
/// is done early helps the others, so that all finish together although cores are not equally fast at all times. Plain
/// numbers, since a node's parameters are copied while the graph is built; between runs all are zero.
class Turns {
 public:
  /// Calls `turn(i)` for some of the numbers [0, n); the threads of a run, all of which must call this, cover them.
  template <class Turn>
  void share(int ith, int nth, std::int64_t n, const Turn& turn) {
    const int n_stretch = nth < kMostStretches ? nth : kMostStretches;
    for (int i = 0; i < n_stretch; ++i) {
      const int stretch = (ith + i) % n_stretch;
      const std::int64_t begin = n * stretch / n_stretch, end = n * (stretch + 1) / n_stretch;
      for (;;) {
        const std::int64_t next = begin + __atomic_fetch_add(&taken_[stretch], 1, __ATOMIC_RELAXED);
        if (next >= end) break;
        turn(next);
      }
    }
    if (__atomic_add_fetch(&left_, 1, __ATOMIC_ACQ_REL) < nth) return;
    for (std::int32_t& taken : taken_) __atomic_store_n(&taken, 0, __ATOMIC_RELAXED);
    __atomic_store_n(&left_, 0, __ATOMIC_RELAXED);  // the next run begins behind a barrier
  }

 private:
  static constexpr int kMostStretches = 16;
  std::int32_t taken_[kMostStretches] = {}, left_ = 0;
};

}  // namespace vla::kernels
