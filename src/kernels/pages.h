// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>

/// Hints to the system about memory, which it may ignore. Pages that are only partly inside are skipped.
namespace vla {

/// Advises huge pages: fewer TLB misses and page faults.
void want_large_pages(void* data, std::size_t size);

/// Faults the memory in now, not at the first write.
void want_memory_now(void* data, std::size_t size);

}  // namespace vla
