// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cli/kept_memory.h"

#include <malloc.h>

#include <algorithm>

namespace vla::cli {
namespace {

constexpr std::size_t kLeastBlock = 4 << 20, kMostBlock = 32 << 20;  // bytes of a block; malloc's maximum
constexpr auto kKeptFor = std::chrono::seconds(30);

}  // namespace

void KeptMemory::answered(const observe::Answered& answered) {
  const std::size_t size = answered.request.size;
  if (answered.error == nullptr && answered.request.kind == wire::Kind::act && size > kept_ / 2) {
    last_ = answered.sent;
    if (size > kept_) keep(size);
  }
  if (kept_ > kLeastBlock / 2 && answered.sent - last_ > kKeptFor) {
    keep(0);
    ::malloc_trim(0);
  }
}

/// Keeps blocks of up to twice `size`, since a buffer that grows may be twice as large as its contents.
void KeptMemory::keep(std::size_t size) {
  kept_ = std::max(size, kLeastBlock / 2);
  const std::size_t block = std::min(2 * kept_, kMostBlock);
  ::mallopt(M_MMAP_THRESHOLD, static_cast<int>(block));
  ::mallopt(M_TRIM_THRESHOLD,
            static_cast<int>(kept_ > kLeastBlock / 2 ? 2 * block : kLeastBlock));  // an act needs a few blocks
}

}  // namespace vla::cli
