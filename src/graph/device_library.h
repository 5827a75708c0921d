// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "graph/device.h"
#include "graph/device_build.h"
#include "graph/rounding.h"

namespace vla {

/// The export of a library such as libvla-cuda.so: devices of one kind, opened as the Device that graphs run on. It
/// carries everything that they need, so that it takes no symbol of the program that loads it, and no other program's
/// ggml can be mistaken for ours. `build` makes sure that both know the same classes.
struct DeviceLibrary {
  const char* build;  // kDeviceBuild
  /// In the order of their numbers. Errors: device, where there is none, with the reason as `found`.
  Result<std::vector<DeviceInfo>> (*list)();
  /// `rounding`: none or bf16. Errors: device, unsupported.
  Result<std::unique_ptr<Device>> (*open)(int index, Rounding rounding);
  /// A device by the name of a model that says how long programs would take (Program::predictions), to be loaded
  /// without being filled; null where there are no such models. Errors: usage, unsupported.
  Result<std::unique_ptr<Device>> (*model)(const std::string& name, Rounding rounding);
};

constexpr const char* kDeviceLibrarySymbol = "vla_device_library";

}  // namespace vla

extern "C" __attribute__((visibility("default"))) const vla::DeviceLibrary* vla_device_library();
