// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>

namespace vla {

/// Bytes of memory that this process takes, as the system counts them; 0 where it does not say.
std::size_t resident_size();

}  // namespace vla
