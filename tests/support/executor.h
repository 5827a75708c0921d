// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>

#include <functional>
#include <utility>

#include "kernels/executor.h"

namespace vla::test {

/// A function as a task of so many items.
struct FunctionTask final : kernels::Task {
  using Function = std::function<void(std::int64_t item, kernels::Worker& worker)>;
  FunctionTask(std::int64_t n, Function f) : function(std::move(f)) { n_item = n; }
  void run(std::int64_t item, kernels::Worker& worker) const override { function(item, worker); }
  Function function;
};

/// One phase of one task on `n_thread` threads.
inline void run_items(std::int64_t n_item, int n_thread, FunctionTask::Function function) {
  const auto executor = kernels::Executor::shared(n_thread);
  REQUIRE(executor.ok());
  const FunctionTask task(n_item, std::move(function));
  const kernels::Phase phase = {{&task}, nullptr};
  (*executor)->run(std::span(&phase, 1));
}

}  // namespace vla::test
