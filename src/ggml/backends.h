// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <ggml-backend.h>

#include <string>
#include <vector>

#include "base/result.h"

namespace vla {

/// A device as `--device` names it: `vulkan:1`.
struct DeviceName {
  std::string kind;
  int index = 0;
  std::string text() const { return kind == "cpu" ? kind : kind + ":" + std::to_string(index); }

  /// "cpu", "vulkan" or "cuda", the last two also with a number; empty text is the CPU. Errors: usage.
  static Result<DeviceName> parse(const std::string& text);
};

/// A device that is there.
struct DeviceInfo {
  std::string name, description;
  std::size_t memory = 0, free = 0;  // bytes
  std::string precision;             // "f32": of products
};

/// What build and machine have: devices, and for each kind that has none the reason.
struct DeviceList {
  std::vector<DeviceInfo> devices;
  std::vector<std::pair<std::string, std::string>> absent;  // kind, reason
};

/// Devices of the backends that are libraries of their own: libvla-vulkan.so and libvla-cuda.so. Each is looked for
/// where the running code lies (the program's folder, or that of libvla.so) and in the library folder beside it, loaded
/// once and kept.
DeviceList backend_devices();
/// Errors: device, with what is there.
Result<ggml_backend_dev_t> find_device(const DeviceName& name);

}  // namespace vla
