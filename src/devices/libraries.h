// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "graph/device_library.h"

namespace vla {

/// Loads a library of devices once and keeps it: libvla-NAME.so, where NAME is vulkan, cuda or cuda-ggml. Searches the
/// folder of the running code (program or libvla.so), then the library folders next to it. Errors: device, with the
/// reason as `found`.
Result<const DeviceLibrary*> device_library(const std::string& kind);

}  // namespace vla
