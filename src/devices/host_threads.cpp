// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "devices/host_threads.h"

#include <algorithm>

#include "kernels/cores.h"
#include "kernels/executor.h"

namespace vla {

Result<HostThreads> HostThreads::start(int n_thread) {
  constexpr int kMost = 8;
  HostThreads threads;
  if (n_thread <= 0) n_thread = static_cast<int>(kernels::big_cores(kernels::allowed_cores()).size());
  if (n_thread > 1) {
    VLA_TRY(threads.executor_, kernels::Executor::shared(std::min(n_thread, kMost)));
  }
  return threads;
}

void HostThreads::run(std::size_t n, const std::function<void(std::size_t)>& item) const {
  if (!executor_) {
    for (std::size_t i = 0; i < n; ++i) item(i);
    return;
  }
  const auto task = kernels::task_of(static_cast<std::int64_t>(n),
                                     [&item](std::int64_t i, kernels::Worker&) { item(static_cast<std::size_t>(i)); });
  const kernels::Phase phase{{task.get()}};
  executor_->run({&phase, 1});
}

}  // namespace vla
