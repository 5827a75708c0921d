// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <ggml-cpp.h>
#include <ggml-cpu.h>

#include <memory>
#include <string>

#include "base/result.h"

namespace vla {

/// Where graphs run. One persistent pool of threads serves every graph; between requests its threads sleep.
class Device {
 public:
  /// The CPU with `n_thread` threads; 0 takes every core that the process may use. Errors: device.
  static Result<Device> cpu(int n_thread);

  ggml_backend_t backend() const { return backend_.get(); }
  int n_thread() const { return n_thread_; }
  std::string name() const;

 private:
  struct PoolDeleter {
    void operator()(ggml_threadpool* pool) const { ggml_threadpool_free(pool); }
  };

  std::unique_ptr<ggml_threadpool, PoolDeleter> pool_;  // declared first: it outlives the backend that uses it
  ggml_backend_ptr backend_;
  int n_thread_ = 0;
};

}  // namespace vla
