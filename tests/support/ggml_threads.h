// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

namespace vla::test {

/// One for ggml, whose threads spin until all have come, which takes long where the machine is busy.
inline int threads_for(const std::string& kernels, int n_thread) { return kernels == "ggml" ? 1 : n_thread; }

}  // namespace vla::test
