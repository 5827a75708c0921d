// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <chrono>

namespace vla {

using Clock = std::chrono::steady_clock;
/// Tells the present time: Clock::now, or a test's, which need not wait.
using Now = Clock::time_point (*)();

}  // namespace vla
