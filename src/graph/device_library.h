// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "graph/device.h"
#include "graph/device_build.h"
#include "graph/rounding.h"

namespace vla {

/// The exports of a library such as libvla-cuda.so: devices of one kind, opened as Device. The library contains
/// everything it needs and imports no symbol from the program, so that another program's ggml cannot be mistaken for
/// ours. `build` ensures that both were compiled with the same classes.
struct DeviceLibrary {
  const char* build;  // kDeviceBuild
  /// The devices in order of their index. Errors: device if there is none, with the reason as `found`.
  Result<std::vector<DeviceInfo>> (*list)();
  /// `rounding`: of matrices at load; a library takes those that its kernels have. Errors: device, unsupported.
  Result<std::unique_ptr<Device>> (*open)(int index, Rounding rounding);
  /// A model of a device, by name, which predicts how long programs would take (Program::predictions). Load it with
  /// `fill` false. Null if there are no such models. Errors: usage, unsupported.
  Result<std::unique_ptr<Device>> (*model)(const std::string& name, Rounding rounding);
};

constexpr const char* kDeviceLibrarySymbol = "vla_device_library";

}  // namespace vla

extern "C" __attribute__((visibility("default"))) const vla::DeviceLibrary* vla_device_library();
