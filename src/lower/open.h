// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "graph/device.h"

namespace vla {

/// The CPU with `n_thread` threads, 0 for every core that the process may use, and the kernels of choose_isa: our own,
/// or ggml's operations as the reference of all others. Errors: device, usage.
Result<std::unique_ptr<Device>> open_device(int n_thread, const std::string& kernels);

}  // namespace vla
