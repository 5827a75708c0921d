// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/open.h"

#include <fmt/format.h>
#include <sched.h>

#include "ggml/ggml_device.h"
#include "lower/cpu_device.h"

namespace vla {
namespace {

constexpr int kMaxThreads = 512;

int usable_cores() {
  cpu_set_t set;
  return sched_getaffinity(0, sizeof(set), &set) == 0 ? CPU_COUNT(&set) : 1;
}

}  // namespace

Result<std::unique_ptr<Device>> open_device(int n_thread, const std::string& kernels) {
  VLA_TRY(const Isa isa, choose_isa(kernels));
  if (n_thread <= 0) n_thread = usable_cores();
  if (n_thread > kMaxThreads)
    return Error{Code::device, "threads", fmt::format("at most {}", kMaxThreads), std::to_string(n_thread)};
  return isa == Isa::ggml ? GgmlDevice::cpu(n_thread) : lower::CpuDevice::open(n_thread, isa);
}

}  // namespace vla
