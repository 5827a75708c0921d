// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <string>

namespace vla {

/// Resident memory of this process in bytes; 0 if the system does not report it.
std::size_t resident_size();

/// Bytes that a process may allocate: the system's available memory, or less under a control group's limit. `meminfo`,
/// `limit` and `used` are the contents of /proc/meminfo and of the group's two files; empty if missing.
std::size_t free_memory(const std::string& meminfo, const std::string& limit, const std::string& used);
std::size_t free_memory();  // reads these three files of this machine

}  // namespace vla
