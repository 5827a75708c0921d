// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "graph/device.h"

namespace vla {

/// A device name for `--device`, such as `vulkan:1`.
struct DeviceName {
  std::string kind;
  int index = 0;
  std::string text() const { return kind == "cpu" ? kind : kind + ":" + std::to_string(index); }

  /// Parses "cpu", "vulkan" or "cuda", the last two optionally with an index; empty text is the CPU. Errors: usage.
  static Result<DeviceName> parse(const std::string& text);
};

/// The devices of this build and machine, and the reason for each kind that has none.
struct DeviceList {
  std::vector<DeviceInfo> devices;                          // the CPU first
  std::vector<std::pair<std::string, std::string>> absent;  // kind, reason
};

DeviceList list_devices();

/// Opens the device that `--device` names (DeviceName::parse). On the CPU it runs `n_thread` threads, 0 for every core
/// that the process may use, with the kernels of Arithmetic: our own, or ggml's operations, which are the reference for
/// all others. `bf16`, `int8` and `int4` round large matrices at load; no other name does. Arithmetic::on_device says
/// which kernels other devices take. An absent device is an error and never replaced. Errors: device, usage.
Result<std::unique_ptr<Device>> open_device(int n_thread, const std::string& kernels, const std::string& device = "");

/// Opens a model of a device that is not present, by name (DeviceLibrary::model). Errors: device, usage, unsupported.
Result<std::unique_ptr<Device>> open_model(const std::string& model, const std::string& kernels,
                                           const std::string& device);

}  // namespace vla
