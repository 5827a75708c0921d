// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <ggml-backend.h>

#include "graph/device_library.h"

namespace vla {

/// A backend of ggml, as libraries of devices describe theirs.
struct GgmlBackend {
  const char* kind;                                  // "vulkan"
  ggml_backend_reg_t (*open)();                      // null where the driver is missing
  std::string (*driver)(ggml_backend_dev_t device);  // its name and version
  bool keeps_f16 = false;                            // its products of f16 weights are as exact as those of float32

  /// As DeviceLibrary::list and DeviceLibrary::open. One backend for each library.
  Result<std::vector<DeviceInfo>> list() const;
  Result<std::unique_ptr<Device>> open_device(int index, Rounding rounding) const;

 private:
  Result<ggml_backend_reg_t> registry() const;
};

/// The export of a backend's library.
template <const GgmlBackend& backend>
DeviceLibrary library_of() {
  return {kDeviceBuild, [] { return backend.list(); },
          [](int index, Rounding rounding) { return backend.open_device(index, rounding); }, nullptr};
}

}  // namespace vla
