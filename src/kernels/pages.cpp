// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/pages.h"

#include <sys/mman.h>
#include <unistd.h>

#include <cstdint>

namespace vla {
namespace {

/// MADV_POPULATE_WRITE, which headers older than Linux 5.14 lack.
constexpr int kPopulateWrite = 23;

void advise(void* data, std::size_t size, int advice) {
  const auto page = static_cast<std::uintptr_t>(sysconf(_SC_PAGESIZE)), start = reinterpret_cast<std::uintptr_t>(data);
  const std::uintptr_t first = (start + page - 1) / page * page, end = (start + size) / page * page;
  if (first < end) madvise(reinterpret_cast<void*>(first), end - first, advice);
}

}  // namespace

void want_large_pages(void* data, std::size_t size) { advise(data, size, MADV_HUGEPAGE); }

void want_memory_now(void* data, std::size_t size) { advise(data, size, kPopulateWrite); }

}  // namespace vla
