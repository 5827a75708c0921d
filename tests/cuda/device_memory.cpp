// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/device_memory.h"

#include <sys/mman.h>
#include <unistd.h>

#include <algorithm>
#include <cstring>
#include <new>

#include "cuda/fault.h"

namespace vla::test::cuda {

DeviceMemory& device_memory() {
  static DeviceMemory memory;
  return memory;
}

DeviceMemory::~DeviceMemory() {
  for (auto& [end, in] : all_) munmap(in.pages, in.mapped);
}

void* DeviceMemory::allocate(std::size_t size) {
  const auto page = static_cast<std::size_t>(sysconf(_SC_PAGESIZE));
  const std::size_t rounded = (size + 15) / 16 * 16, mapped = (rounded + page - 1) / page * page + page;
  void* pages = mmap(nullptr, mapped, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
  if (pages == MAP_FAILED) throw std::bad_alloc();
  auto* guard = static_cast<std::byte*>(pages) + mapped - page;
  mprotect(guard, page, PROT_NONE);
  std::byte* first = guard - rounded;
  std::memset(first, kGarbage, rounded);
  Allocation in;
  in.first = reinterpret_cast<std::uintptr_t>(first), in.end = in.first + size;
  in.writer.resize(rounded / 4), in.reader.resize(rounded / 4);
  in.pages = static_cast<std::byte*>(pages), in.mapped = mapped;
  all_.emplace(in.first + rounded, std::move(in));
  return first;
}

void DeviceMemory::release(void* p) {
  const auto found = all_.upper_bound(reinterpret_cast<std::uintptr_t>(p));
  if (found == all_.end() || found->second.first != reinterpret_cast<std::uintptr_t>(p))
    throw Fault("what is released was not allocated");
  munmap(found->second.pages, found->second.mapped);
  all_.erase(found);
}

DeviceMemory::Allocation* DeviceMemory::check(std::uintptr_t p, std::size_t size, bool writes, Allocation* hint) {
  if (p % size != 0) throw Fault("address of " + std::to_string(size) + " bytes is not aligned");
  if (hint == nullptr || p < hint->first || p + size > hint->end) {
    const auto found = all_.upper_bound(p);
    if (found == all_.end() || p < found->second.first || p + size > found->second.end)
      throw Fault(std::string(writes ? "writes" : "reads") + " behind or before an allocation");
    hint = &found->second;
  }
  if (size >= 4) check_race(*hint, p, size, writes);
  return hint;
}

bool DeviceMemory::has_result(const Allocation& in, std::uintptr_t p, std::size_t size) {
  const std::size_t first = (p - in.first) / 4, end = (p - in.first + size + 3) / 4;
  return std::any_of(in.writer.begin() + static_cast<std::ptrdiff_t>(first),
                     in.writer.begin() + static_cast<std::ptrdiff_t>(end),
                     [](std::uint32_t block) { return block != 0; });
}

void DeviceMemory::check_race(Allocation& in, std::uintptr_t p, std::size_t size, bool writes) {
  for (std::size_t word = (p - in.first) / 4, end = word + size / 4; word < end; ++word) {
    const std::uint32_t writer = in.writer[word], reader = in.reader[word];
    if (writer >= launch_ && writer != current_) throw Fault("two blocks of a launch touch what one of them writes");
    if (!writes) {
      in.reader[word] = current_;
      continue;
    }
    if (reader >= launch_ && reader != current_) throw Fault("two blocks of a launch touch what one of them writes");
    in.writer[word] = current_;
  }
}

}  // namespace vla::test::cuda
