// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <map>
#include <vector>

namespace vla::test::cuda {

/// Byte of memory that nobody has written: floats of it are NaN.
constexpr int kGarbage = 0xff;

/// Memory of a device, which is the host's. An allocation ends at a page that nobody may touch: a kernel that the
/// host's compiler has made ends the program there. The interpreter asks before every access, to the byte, and also
/// whether two blocks of a launch touch one word of which at least one writes it; words are of 4 bytes, and smaller
/// accesses are left out, as blocks may share a word.
class DeviceMemory {
 public:
  struct Allocation {
    std::uintptr_t first = 0, end = 0;
    std::vector<std::uint32_t> writer, reader;  // of each word, the last block: numbers of `begin_block`
    std::byte* pages = nullptr;
    std::size_t mapped = 0;
  };

  ~DeviceMemory();
  /// At least 16 bytes aligned.
  void* allocate(std::size_t size);
  /// A Fault where it is none of ours.
  void release(void* p);
  std::size_t n_allocation() const { return all_.size(); }

  void begin_launch() { launch_ = block_ + 1; }
  /// The number of a block that begins.
  std::uint32_t begin_block() { return ++block_; }
  /// What follows is done by a block that has begun.
  void go_on(std::uint32_t block) { current_ = block; }
  /// Whether a kernel has written any word of [p, p + size).
  static bool has_result(const Allocation& in, std::uintptr_t p, std::size_t size);
  /// Checks an access and tells in which allocation it is; `hint` may be where the last one was, or null.
  Allocation* check(std::uintptr_t p, std::size_t size, bool writes, Allocation* hint);

 private:
  void check_race(Allocation& in, std::uintptr_t p, std::size_t size, bool writes);

  std::map<std::uintptr_t, Allocation> all_;            // by the end
  std::uint32_t block_ = 0, launch_ = 0, current_ = 0;  // block_: the last that began
};

/// The only device.
DeviceMemory& device_memory();

}  // namespace vla::test::cuda
