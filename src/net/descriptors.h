// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>

namespace vla::net {

/// How many file descriptors this process can still open, after raising its limit as far as the system allows.
std::size_t spare_descriptors();

}  // namespace vla::net
