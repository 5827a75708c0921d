// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "backend/device.h"

#include <fmt/format.h>
#include <sched.h>

namespace vla {
namespace {

int usable_cores() {
  cpu_set_t set;
  return sched_getaffinity(0, sizeof(set), &set) == 0 ? CPU_COUNT(&set) : 1;
}

}  // namespace

Result<Device> Device::cpu(int n_thread, const std::string& kernels) {
  ggml_log_set([](ggml_log_level, const char*, void*) {}, nullptr);  // what fails becomes an Error, told once
  Device device;
  VLA_TRY(device.isa_, choose_isa(kernels));
  device.n_thread_ = n_thread > 0 ? n_thread : usable_cores();
  if (device.n_thread_ > GGML_MAX_N_THREADS)
    return Error{Code::device, "threads", fmt::format("at most {}", GGML_MAX_N_THREADS),
                 std::to_string(device.n_thread_)};
  device.scratch_ = std::make_shared<Scratch>(device.n_thread_);
  device.backend_.reset(ggml_backend_cpu_init());
  if (!device.backend_) return Error{Code::device, "cpu", "a backend", "the system refused it"};
  ggml_threadpool_params pool = ggml_threadpool_params_default(device.n_thread_);
  device.pool_.reset(ggml_threadpool_new(&pool));
  ggml_backend_cpu_set_threadpool(device.backend_.get(), device.pool_.get());
  ggml_backend_cpu_set_n_threads(device.backend_.get(), device.n_thread_);
  return device;
}

std::string Device::name() const { return fmt::format("cpu, {} thread{}", n_thread_, n_thread_ == 1 ? "" : "s"); }

}  // namespace vla
