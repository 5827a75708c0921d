// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <string>

namespace vla::door {

/// Limits of a process that reads data from strangers.
struct Limits {
  std::size_t memory = 0;       // bytes
  std::size_t descriptors = 0;  // open at once
};

/// Applies the limits, makes this process end with `parent`, and closes all descriptors from `n_kept` on.
void confine(const Limits& limits, int parent, int n_kept);
/// Allows only the system calls for sockets and memory. Returns which protection is missing on this system, or "".
std::string confine_calls();

}  // namespace vla::door
