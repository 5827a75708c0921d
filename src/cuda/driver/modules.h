// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

namespace vla::cuda {

/// All kernels as Gpu::open takes them: PTX inside the library, and behind some their machine code; or the names that a
/// test's driver knows.
std::vector<std::string> kernel_modules();

}  // namespace vla::cuda
