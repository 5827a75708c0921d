// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "graph/device.h"

namespace vla {

/// A device as `--device` names it: `vulkan:1`.
struct DeviceName {
  std::string kind;
  int index = 0;
  std::string text() const { return kind == "cpu" ? kind : kind + ":" + std::to_string(index); }

  /// "cpu", "vulkan" or "cuda", the last two also with a number; empty text is the CPU. Errors: usage.
  static Result<DeviceName> parse(const std::string& text);
};

/// The devices of this build and machine, and for each kind that has none the reason.
struct DeviceList {
  std::vector<DeviceInfo> devices;                          // the CPU first
  std::vector<std::pair<std::string, std::string>> absent;  // kind, reason
};

DeviceList list_devices();

/// Opens the device that `--device` names (DeviceName::parse), the CPU for empty text. On the CPU `n_thread` threads
/// run, 0 for every core that the process may use, with the kernels of Arithmetic: our own, or ggml's operations as the
/// reference of all others; `bf16` and `int8` round large matrices as they are loaded, which no other name does. Other
/// devices take what Arithmetic::on_device says. A device that is absent is refused, and nothing takes its place.
/// Errors: device, usage.
Result<std::unique_ptr<Device>> open_device(int n_thread, const std::string& kernels, const std::string& device = "");

/// A device of a kind that is not there, by the name of a model (DeviceLibrary::model). Errors: device, usage,
/// unsupported.
Result<std::unique_ptr<Device>> open_model(const std::string& model, const std::string& kernels,
                                           const std::string& device);

}  // namespace vla
