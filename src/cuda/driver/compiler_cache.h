// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

namespace vla::cuda {

/// The folder where NVIDIA's driver should cache the machine code that it compiles from our PTX; compiling takes ten
/// seconds or more. Empty if the driver has a folder already: CUDA_CACHE_PATH, or .nv in a writable home. A service or
/// a bare container has neither; then this is a folder in XDG_CACHE_HOME, or else one for temporary files that this
/// function creates and only this user can access. Empty too if neither is writable: then every process compiles.
std::string compiler_cache();

}  // namespace vla::cuda
