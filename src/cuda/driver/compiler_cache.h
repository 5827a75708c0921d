// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

namespace vla::cuda {

/// The folder in which NVIDIA's driver is to keep the machine code that it compiles of our PTX, ten seconds of work
/// and more, for the next process. Empty where the driver has one: CUDA_CACHE_PATH, or .nv in a home that it may write
/// to. A service and a bare container have neither; then XDG_CACHE_HOME is taken, or a folder for temporary files that
/// only this user can read and write, which is made. Empty too where there is no such folder: every process compiles
/// then.
std::string compiler_cache();

}  // namespace vla::cuda
