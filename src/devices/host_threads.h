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

/// Threads of the host that prepare what another device computes. Idle ones sleep.
class HostThreads {
 public:
  /// At most eight, since more of them wait for memory; n_thread: the most, 0 for every core that the process may use.
  /// Errors: device if the system refuses a thread.
  static Result<HostThreads> start(int n_thread);
  HostThreads() = default;

  /// Calls `item` with each number below `n`, in any order; without threads one after the other. Any thread may call
  /// it. `item` must not throw.
  void run(std::size_t n, const std::function<void(std::size_t)>& item) const;

 private:
  std::shared_ptr<kernels::Executor> executor_;  // shared by all of as many threads; null: the caller alone
};

}  // namespace vla
