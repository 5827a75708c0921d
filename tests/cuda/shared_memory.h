// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <deque>
#include <span>
#include <vector>

namespace vla::test::cuda {

constexpr int kWarp = 32;

/// What the blocks of launches did since it was cleared.
struct Counts {
  long mma, matrices, bank_conflicts, copies, barriers, instructions;
};
inline Counts counts = {};

/// Copies may arrive at once or as late as they are waited for; both are a GPU's. Warps, and with the host's compiler
/// lanes, go on in order, or shuffled where the seed is not 0.
struct Schedule {
  unsigned seed = 0;
  bool late_copies = true;
};
inline Schedule schedule = {};

/// The shared memory of the block that runs. Every access is checked: range, alignment, and order. Two threads that
/// touch one word of 4 bytes, of which one writes it, need a barrier between them, or within a warp a __syncwarp.
class SharedMemory {
 public:
  /// A block begins, with garbage.
  void begin(std::size_t size, int n_thread);
  std::byte* data() { return data_; }
  std::size_t offset(const void* p) const { return static_cast<std::size_t>(static_cast<const std::byte*>(p) - data_); }

  void read(std::size_t offset, std::size_t size, int thread);
  void write(std::size_t offset, std::size_t size, int thread);
  void barrier() { ++time_; }
  void warp_barrier(int warp) { ++warp_time_[static_cast<std::size_t>(warp)]; }

  /// Asynchronous copies: zeros behind `size` of 16 bytes.
  void copy(std::size_t offset, const void* from, std::size_t size, int thread);
  void commit(int thread);
  void wait(std::size_t n_left, int thread);

  /// Counts what lanes wait for each other when they access `width` bytes at each offset: those of one bank, but for
  /// the same word, go one after the other. Up to 128 bytes are one transaction. Lanes with kNone take no part.
  static constexpr std::size_t kNone = ~std::size_t{0};
  static void count_conflicts(std::span<const std::size_t> offsets, std::size_t width);

 private:
  struct Event {
    int thread = -1;  // or, of readers, one of the values below
    std::uint64_t time = 0, warp_time = 0;
  };
  struct Word {
    Event write, read;
  };
  struct Copy {
    std::size_t offset;
    const void* from;
    std::size_t size;
  };
  static constexpr int kNobody = -1, kManyOfWarp = 1 << 20, kMany = 1 << 21;
  static constexpr std::uint64_t kPending = ~std::uint64_t{0};

  void check_range(std::size_t offset, std::size_t size) const;
  bool ordered(const Event& event, int thread) const;
  Event now(int thread) const { return {thread, time_, warp_time_[static_cast<std::size_t>(thread / kWarp)]}; }
  void arrive(const Copy& copy, int thread);

  std::vector<std::byte> room_;
  std::byte* data_ = nullptr;
  std::size_t size_ = 0;
  std::vector<Word> words_;
  std::uint64_t time_ = 1;  // barriers of this block and those before it
  std::vector<std::uint64_t> warp_time_;
  std::vector<std::vector<Copy>> open_;                   // of each thread, since its last commit
  std::vector<std::deque<std::vector<Copy>>> committed_;  // the oldest group first
};

}  // namespace vla::test::cuda
