// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "ggml/ggml_library.h"

#include <fmt/format.h>

#include "ggml/ggml_device.h"

namespace vla {

/// Opens the backend once, since drivers are slow.
Result<ggml_backend_reg_t> GgmlBackend::registry() const {
  static const Result<ggml_backend_reg_t> opened = [this]() -> Result<ggml_backend_reg_t> {
    set_guard();
    ggml_backend_reg_t found = nullptr;
    VLA_CHECK(guarded(kind, [&] { found = open(); }));
    if (found == nullptr) return Error{Code::device, kind, "a driver", "no driver of it on this machine"};
    if (ggml_backend_reg_dev_count(found) == 0)
      return Error{Code::device, kind, "a device", "its driver shows no device"};
    return found;
  }();
  return opened;
}

/// Descriptions include the driver and its version, which a report of wrong values needs first.
Result<std::vector<DeviceInfo>> GgmlBackend::list() const {
  VLA_TRY(ggml_backend_reg_t found, registry());
  std::vector<DeviceInfo> devices;
  for (std::size_t i = 0; i < ggml_backend_reg_dev_count(found); ++i) {
    ggml_backend_dev_t device = ggml_backend_reg_dev_get(found, i);
    DeviceInfo& info = devices.emplace_back(
        DeviceInfo{fmt::format("{}:{}", kind, i), ggml_backend_dev_description(device), 0, 0, "f32, bf16"});
    const Status told = guarded(info.name, [&] {
      info.description += "; " + driver(device);
      ggml_backend_dev_memory(device, &info.free, &info.memory);
    });
    if (!told) info.description += "; " + told.error().found;
  }
  return devices;
}

Result<std::unique_ptr<Device>> GgmlBackend::open_device(int index, Rounding rounding) const {
  VLA_TRY(ggml_backend_reg_t found, registry());
  return GgmlDevice::open(ggml_backend_reg_dev_get(found, static_cast<std::size_t>(index)),
                          fmt::format("{}:{}", kind, index), keeps_f16, rounding);
}

}  // namespace vla
