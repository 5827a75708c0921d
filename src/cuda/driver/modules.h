// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

namespace vla::cuda {

/// All modules, as Gpu::open takes them: the library's PTX texts, some followed by their machine code. A test links its
/// own definition, which returns the module name that its driver knows.
std::vector<std::string> kernel_modules();

}  // namespace vla::cuda
