// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <ggml-cpp.h>
#include <ggml-cpu.h>

#include <memory>
#include <string>

#include "backend/isa.h"
#include "backend/scratch.h"
#include "base/result.h"

namespace vla {

/// Where graphs run. The threads belong to the OpenMP runtime, which keeps them and lets them sleep between requests.
class Device {
 public:
  /// The CPU with `n_thread` threads, 0 for every core that the process may use, and the kernels of choose_isa.
  /// Errors: device, usage.
  static Result<Device> cpu(int n_thread, const std::string& kernels);

  ggml_backend_t backend() const { return backend_.get(); }
  int n_thread() const { return n_thread_; }
  Isa isa() const { return isa_; }
  const std::shared_ptr<Scratch>& scratch() const { return scratch_; }
  std::string name() const;

 private:
  struct FreePool {
    void operator()(ggml_threadpool* pool) const { ggml_threadpool_free(pool); }
  };

  // What threads share during a run; without one of ours ggml makes and frees one in every run.
  std::unique_ptr<ggml_threadpool, FreePool> pool_;
  ggml_backend_ptr backend_;
  int n_thread_ = 0;
  Isa isa_ = Isa::ggml;
  std::shared_ptr<Scratch> scratch_;
};

}  // namespace vla
