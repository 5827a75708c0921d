// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <ggml-backend.h>

#include "graph/device_library.h"

namespace vla {

/// Describes a ggml backend for a library of devices.
struct GgmlBackend {
  const char* kind;                                  // "vulkan"
  ggml_backend_reg_t (*open)();                      // null if the driver is missing
  std::string (*driver)(ggml_backend_dev_t device);  // the driver's name and version
  bool keeps_f16 = false;                            // products of f16 weights are as exact as those of float32

  /// DeviceLibrary::list and DeviceLibrary::open for one backend per library.
  Result<std::vector<DeviceInfo>> list() const;
  Result<std::unique_ptr<Device>> open_device(int index, Rounding rounding) const;

 private:
  Result<ggml_backend_reg_t> registry() const;
};

/// The DeviceLibrary that a backend's library exports.
template <const GgmlBackend& backend>
DeviceLibrary library_of() {
  return {kDeviceBuild, [] { return backend.list(); },
          [](int index, Rounding rounding) { return backend.open_device(index, rounding); }, nullptr};
}

}  // namespace vla
