// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>

namespace vla::net {

/// How many file descriptors this process can still open, once its limit is raised as far as the system lets it.
std::size_t spare_descriptors();

}  // namespace vla::net
