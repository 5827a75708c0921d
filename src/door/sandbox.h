// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <string>

namespace vla::door {

/// What a process may take that reads what strangers send.
struct Limits {
  std::size_t memory = 0;       // bytes
  std::size_t descriptors = 0;  // at once
};

/// Ends with the process `parent`, keeps no descriptors but the first `n_kept`, and has these limits from now on.
void confine(const Limits& limits, int parent, int n_kept);
/// Allows only the system calls that serve sockets and memory. Returns what is missing of that; empty if nothing is.
std::string confine_calls();

}  // namespace vla::door
