// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/open.h"

#include <fmt/format.h>
#include <sched.h>
#include <unistd.h>

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

Result<std::unique_ptr<Device>> open_device(int n_thread, const std::string& kernels, const std::string& device) {
  VLA_TRY(const DeviceName name, DeviceName::parse(device));
  const Rounding rounding = rounding_of(kernels);
  if (name.kind != "cpu") {
    if (rounding == Rounding::bf16 || kernels.empty() || kernels == "float32" || kernels == isa_name(Isa::ggml))
      return GgmlDevice::open(name, rounding);
    return Error{Code::usage, "kernels", fmt::format("none, float32, bf16 or ggml with device {}", name.text()),
                 kernels, "other kernels are the CPU's"};
  }
  const bool to_int8 = rounding == Rounding::int8;
  VLA_TRY(const Isa isa, choose_isa(to_int8 ? "" : kernels));
  if (to_int8 && isa == Isa::ggml)
    return Error{Code::device, "kernels", "a machine with AVX2", kernels, "leave the choice to the program"};
  if (n_thread <= 0) n_thread = usable_cores();
  if (n_thread > kMaxThreads)
    return Error{Code::device, "threads", fmt::format("at most {}", kMaxThreads), std::to_string(n_thread)};
  return isa == Isa::ggml ? GgmlDevice::cpu(n_thread) : lower::CpuDevice::open(n_thread, isa, rounding);
}

DeviceList list_devices() {
  DeviceList list = backend_devices();
  const auto pages = [](int which) {
    return static_cast<std::size_t>(sysconf(which)) * static_cast<std::size_t>(sysconf(_SC_PAGESIZE));
  };
  const Isa best = usable_isas().back();
  DeviceInfo cpu = {"cpu", fmt::format("{} threads, {}", usable_cores(), isa_name(best)), pages(_SC_PHYS_PAGES),
                    pages(_SC_AVPHYS_PAGES), rounds_to_bf16(best) ? "f32, bf16" : "f32"};
  list.devices.insert(list.devices.begin(), std::move(cpu));
  return list;
}

}  // namespace vla
