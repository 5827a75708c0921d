// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "ggml/backends.h"
#include "graph/device.h"

namespace vla {

/// What `--device` names (DeviceName::parse); empty text is the CPU. On the CPU `n_thread` threads run, 0 for every
/// core that the process may use, with the kernels of Arithmetic: our own, or ggml's operations as the reference of all
/// others; `bf16` and `int8` round large matrices when they are loaded, which no other name does. Other devices have
/// the kernels of ggml alone, in float32, or with `bf16` in such products. A device that is absent is refused, and
/// nothing takes its place. Errors: device, usage.
Result<std::unique_ptr<Device>> open_device(int n_thread, const std::string& kernels, const std::string& device = "");

/// The CPU first.
DeviceList list_devices();

}  // namespace vla
