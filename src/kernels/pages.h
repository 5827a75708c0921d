// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>

/// Hints about memory that the system may ignore. Pages that are only partly inside are left alone.
namespace vla {

/// Large pages: fewer of them are looked up while weights and activations stream by, and fewer are made.
void want_large_pages(void* data, std::size_t size);

/// The memory itself now, not at the first write.
void want_memory_now(void* data, std::size_t size);

}  // namespace vla
