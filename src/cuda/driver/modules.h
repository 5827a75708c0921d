// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

namespace vla::cuda {

/// All kernels, as texts that a driver loads: PTX inside of the library, or what the driver of tests knows theirs by.
std::vector<std::string> kernel_modules();

}  // namespace vla::cuda
