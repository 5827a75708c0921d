// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "graph/device_library.h"

namespace vla {

/// A library of devices: libvla-vulkan.so, libvla-cuda.so or libvla-cuda-ggml.so by what follows `libvla-`, looked for
/// where the running code lies (the program's folder, or that of libvla.so) and in the library folder beside it, loaded
/// once and kept. Errors: device, with the reason as `found`.
Result<const DeviceLibrary*> device_library(const std::string& kind);

}  // namespace vla
