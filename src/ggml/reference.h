// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "graph/device.h"

namespace vla {

/// The CPU with ggml's plain operations, for who may not know ggml: GgmlDevice::cpu. Errors: device.
Result<std::unique_ptr<Device>> open_reference(int n_thread);

}  // namespace vla
