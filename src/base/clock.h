// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <chrono>

namespace vla {

using Clock = std::chrono::steady_clock;

}  // namespace vla
