// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <string>

namespace vla::door {

/// Limits of a process that reads data from strangers.
struct Limits {
  std::size_t memory = 0;       // bytes
  std::size_t descriptors = 0;  // at once
};

/// Applies the limits: this process ends with `parent`, and closes all descriptors but the first `n_kept`.
void confine(const Limits& limits, int parent, int n_kept);
/// Allows only the system calls for sockets and memory. Returns which protection is missing on this system, or "".
std::string confine_calls();

}  // namespace vla::door
