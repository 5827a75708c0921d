// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "graph/device_library.h"

namespace vla {

/// Loads a library of devices once and keeps it: libvla-NAME.so, where NAME is vulkan, cuda or cuda-ggml. It is
/// searched beside the running code (program or libvla.so) and in the library folder beside that. Errors: device, with
/// the reason as `found`.
Result<const DeviceLibrary*> device_library(const std::string& kind);

}  // namespace vla
