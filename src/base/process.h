// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>

namespace vla {

/// Resident memory of this process in bytes, from the system; 0 where the system does not tell.
std::size_t resident_size();

}  // namespace vla
