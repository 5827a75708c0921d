// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/host/memory.h"

#include <fmt/format.h>
#include <sys/mman.h>

#include "kernels/pages.h"

namespace vla::lower {

Result<Memory> Memory::map(std::size_t size, const std::string& what, int protection, int flags, Pages pages) {
  Memory memory;
  if (size == 0) return memory;
  void* data = mmap(nullptr, size, protection, MAP_PRIVATE | MAP_ANONYMOUS | flags, -1, 0);
  if (data == MAP_FAILED)
    return Error{Code::out_of_memory, what, "",
                 fmt::format("the system refused {:.1f} MB", 1e-6 * static_cast<double>(size)),
                 "free memory or use a smaller model"};
  memory.data_.reset(static_cast<std::byte*>(data), [size](std::byte* bytes) { munmap(bytes, size); });
  memory.size_ = size;
  if (pages == Pages::large) want_large_pages(data, size);
  return memory;
}

Result<Memory> Memory::allocate(std::size_t size, const std::string& what, Pages pages) {
  return map(size, what, PROT_READ | PROT_WRITE, 0, pages);
}

Result<Memory> Memory::reserve(std::size_t size, const std::string& what) {
  return map(size, what, PROT_READ, MAP_NORESERVE, Pages::large);
}

}  // namespace vla::lower
