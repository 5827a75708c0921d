// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <functional>
#include <memory>

#include "base/result.h"

namespace vla {

namespace kernels {
class Executor;
}

/// Host threads that prepare the inputs of another device. Idle threads sleep.
class HostThreads {
 public:
  /// Starts at most eight threads, since more of them wait for memory. n_thread: the maximum; 0: every core that the
  /// process may use. Errors: device if the system refuses a thread.
  static Result<HostThreads> start(int n_thread);
  HostThreads() = default;

  /// Calls `item` with each number below `n`, in any order; without threads one after the other. Any thread may call
  /// it. `item` must not throw.
  void run(std::size_t n, const std::function<void(std::size_t)>& item) const;

 private:
  std::shared_ptr<kernels::Executor> executor_;  // shared by all users of this many threads; null: no threads
};

}  // namespace vla
