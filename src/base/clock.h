// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <chrono>

namespace vla {

using Clock = std::chrono::steady_clock;
/// Returns the current time: Clock::now, or a test's clock that can be advanced without waiting.
using Now = Clock::time_point (*)();

}  // namespace vla
