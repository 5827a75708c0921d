// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "graph/device.h"

namespace vla {

/// Opens the CPU with ggml's plain operations (GgmlDevice::cpu), for callers that do not include ggml. Errors: device.
Result<std::unique_ptr<Device>> open_reference(int n_thread);

}  // namespace vla
