// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "devices/devices.h"

#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <charconv>

#include "devices/libraries.h"
#include "ggml/reference.h"
#include "kernels/cores.h"
#include "lower/cpu/cpu_device.h"

namespace vla {
namespace {

constexpr const char* kKinds[] = {"vulkan", "cuda"};
constexpr int kMaxThreads = 512;

int usable_cores() { return static_cast<int>(kernels::big_cores(kernels::allowed_cores()).size()); }

DeviceInfo cpu() {
  const auto pages = [](int which) {
    return static_cast<std::size_t>(sysconf(which)) * static_cast<std::size_t>(sysconf(_SC_PAGESIZE));
  };
  return {"cpu", fmt::format("{} threads, {}", usable_cores(), name_of(this_cpu())), pages(_SC_PHYS_PAGES),
          pages(_SC_AVPHYS_PAGES), rounds_to_bf16(this_cpu()) ? "f32, bf16" : "f32"};
}

Result<std::vector<DeviceInfo>> list(const std::string& library) {
  VLA_TRY(const DeviceLibrary* loaded, device_library(library));
  return loaded->list();
}

/// The name of the library for a kind of device and a backend: CUDA has one library for our own kernels and one for
/// ggml's backend.
std::string library_of(const std::string& kind, Arithmetic::Backend backend) {
  return kind == "cuda" && backend == Arithmetic::Backend::ggml ? "cuda-ggml" : kind;
}

Result<std::unique_ptr<Device>> open_cpu(int n_thread, const std::string& kernels) {
  VLA_TRY(const Arithmetic arithmetic, Arithmetic::on_cpu(kernels, this_cpu()));
  if (n_thread <= 0) n_thread = usable_cores();
  if (n_thread > kMaxThreads)
    return Error{Code::device, "threads", fmt::format("at most {}", kMaxThreads), std::to_string(n_thread)};
  if (arithmetic.backend == Arithmetic::Backend::ggml) return open_reference(n_thread);
  return lower::CpuDevice::open(n_thread, arithmetic);
}

/// The error for an absent device, with the devices that are present.
Error absent(const DeviceName& name, const std::string& reason) {
  std::string here;
  for (const DeviceInfo& device : list_devices().devices)
    here += device.name == "cpu" ? device.name : fmt::format(", {} ({})", device.name, device.description);
  return {Code::device, name.text(), "one of " + here, reason,
          "vla inspect --devices lists them; docs/gpu.md says what each needs"};
}

}  // namespace

Result<DeviceName> DeviceName::parse(const std::string& text) {
  if (text.empty() || text == "cpu") return DeviceName{"cpu"};
  const std::size_t colon = std::min(text.find(':'), text.size());
  DeviceName name = {text.substr(0, colon)};
  const bool known = std::find(std::begin(kKinds), std::end(kKinds), name.kind) != std::end(kKinds);
  const char *at = text.data() + std::min(colon + 1, text.size()), *end = text.data() + text.size();
  const auto [next, error] = std::from_chars(at, end, name.index);
  const bool counts = colon == text.size() || (error == std::errc() && next == end && name.index >= 0);
  if (known && counts) return name;
  return Error{Code::usage, "device", "cpu, vulkan, vulkan:N, cuda or cuda:N", text};
}

DeviceList list_devices() {
  DeviceList all = {{cpu()}, {}};
  for (const char* kind : kKinds) {
    const Result<std::vector<DeviceInfo>> found = list(kind);
    if (found)
      all.devices.insert(all.devices.end(), found->begin(), found->end());
    else
      all.absent.emplace_back(kind, found.error().found);
  }
  return all;
}

Result<std::unique_ptr<Device>> open_device(int n_thread, const std::string& kernels, const std::string& device) {
  VLA_TRY(const DeviceName name, DeviceName::parse(device));
  if (name.kind == "cpu") return open_cpu(n_thread, kernels);
  VLA_TRY(const Arithmetic arithmetic, Arithmetic::on_device(kernels, name.text()));
  const std::string library = library_of(name.kind, arithmetic.backend);
  const Result<std::vector<DeviceInfo>> found = list(library);
  if (!found) return absent(name, found.error().found);
  if (static_cast<std::size_t>(name.index) >= found->size()) return absent(name, "none with this number");
  return (*device_library(library))->open(name.index, arithmetic.at_load);
}

Result<std::unique_ptr<Device>> open_model(const std::string& model, const std::string& kernels,
                                           const std::string& device) {
  VLA_TRY(const DeviceName name, DeviceName::parse(device));
  if (name.kind != "cuda")
    return Error{Code::usage, "model", "device cuda", name.text(), "other devices have no model"};
  VLA_TRY(const Arithmetic arithmetic, Arithmetic::on_device(kernels, name.text()));
  const Result<const DeviceLibrary*> library = device_library(library_of(name.kind, arithmetic.backend));
  if (!library) return library.error();
  if ((*library)->model == nullptr)
    return Error{Code::usage, "model", "our own kernels", "--kernels " + kernels, "leave --kernels out"};
  return (*library)->model(model, arithmetic.at_load);
}

}  // namespace vla
