// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/open.h"

#include <fmt/format.h>
#include <sched.h>
#include <unistd.h>

#include "ggml/ggml_device.h"
#include "lower/cpu/cpu_device.h"

namespace vla {
namespace {

constexpr int kMaxThreads = 512;

int usable_cores() {
  cpu_set_t set;
  return sched_getaffinity(0, sizeof(set), &set) == 0 ? CPU_COUNT(&set) : 1;
}

}  // namespace

Result<std::unique_ptr<Device>> open_device(int n_thread, const std::string& kernels, const std::string& device) {
  VLA_TRY(const DeviceName name, DeviceName::parse(device));
  if (name.kind != "cpu") {
    VLA_TRY(const Arithmetic arithmetic, Arithmetic::on_device(kernels, name.text()));
    return GgmlDevice::open(name, arithmetic.at_load);
  }
  VLA_TRY(const Arithmetic arithmetic, Arithmetic::on_cpu(kernels, this_cpu()));
  if (n_thread <= 0) n_thread = usable_cores();
  if (n_thread > kMaxThreads)
    return Error{Code::device, "threads", fmt::format("at most {}", kMaxThreads), std::to_string(n_thread)};
  if (arithmetic.backend == Arithmetic::Backend::ggml) return GgmlDevice::cpu(n_thread);
  return lower::CpuDevice::open(n_thread, arithmetic);
}

DeviceList list_devices() {
  DeviceList list = backend_devices();
  const auto pages = [](int which) {
    return static_cast<std::size_t>(sysconf(which)) * static_cast<std::size_t>(sysconf(_SC_PAGESIZE));
  };
  DeviceInfo cpu = {"cpu", fmt::format("{} threads, {}", usable_cores(), name_of(this_cpu())), pages(_SC_PHYS_PAGES),
                    pages(_SC_AVPHYS_PAGES), rounds_to_bf16(this_cpu()) ? "f32, bf16" : "f32"};
  list.devices.insert(list.devices.begin(), std::move(cpu));
  return list;
}

}  // namespace vla
