// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

namespace vla::cuda {

/// All kernels as texts for a driver: PTX inside the library, or the names that a test's driver knows.
std::vector<std::string> kernel_modules();

}  // namespace vla::cuda
