// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <map>
#include <random>
#include <span>
#include <vector>

#include "cuda/mbarrier.h"

namespace vla::test::cuda {

constexpr int kWarp = 32;

/// What the blocks of launches did since it was cleared.
struct Counts {
  long mma, matrices, bank_conflicts, copies, barriers, instructions;
};
inline Counts counts = {};

/// Copies may arrive at once or as late as they are waited for, those that an mbarrier counts once no thread can go on;
/// both are a GPU's. Warps, and with the host's compiler
/// lanes, go on in order, or shuffled where the seed is not 0.
struct Schedule {
  unsigned seed = 0;
  bool late_copies = true;
};
inline Schedule schedule = {};

/// The shared memory of a block that runs. Every access is checked: range, alignment, and order. Two threads that touch
/// one word of 4 bytes, of which one writes it, need a barrier between them, or within a warp a __syncwarp. Threads of
/// two blocks need a barrier of their cluster that releases, and a block that was read may not end before one. What
/// follows an mbarrier's phase is after what its arrivals followed; reads of several warps of one word are not told
/// apart there.
class SharedMemory {
 public:
  /// Block `rank` of a cluster begins, with garbage.
  void begin(std::size_t size, int n_thread, std::size_t rank);
  std::byte* data() { return data_; }
  std::size_t offset(const void* p) const { return static_cast<std::size_t>(static_cast<const std::byte*>(p) - data_); }

  void read(std::size_t offset, std::size_t size, int thread);
  void write(std::size_t offset, std::size_t size, int thread);
  void barrier();
  void warp_barrier(int warp);

  /// A thread of another block of the cluster reads.
  void read_by_other(std::size_t offset, std::size_t size);
  /// All threads of the cluster have met. If it releases, other blocks may read what was written before.
  void cluster_barrier(bool releases);
  /// All threads of the block have ended.
  void end();

  /// Asynchronous copies: zeros behind `size` of 16 bytes.
  void copy(std::size_t offset, const void* from, std::size_t size, int thread);
  void commit(int thread);
  void wait(std::size_t n_left, int thread);

  /// mbarriers. A thread of this block begins one, and makes those that it has begun visible to other blocks and
  /// copies.
  void begin_mbarrier(std::size_t offset, int n_arrival, int thread);
  void fence_mbarriers(int thread);
  /// A thread of a block, this one or another of the cluster, arrives and expects bytes of copies.
  void arrive(std::size_t offset, std::int64_t n_byte, SharedMemory& block, int thread);
  /// Whether the phase of this parity has ended.
  bool try_wait(std::size_t offset, unsigned parity, int thread);
  /// A thread of a block, this one or another of the cluster, asks for a copy, which an mbarrier here counts.
  void bulk_copy(std::size_t offset, const std::vector<std::byte>& bytes, std::size_t mbarrier, SharedMemory& block,
                 int thread);
  /// One copy on its way to these blocks arrives, the oldest if nothing is shuffled. Whether there was one.
  static bool bring_one(std::span<SharedMemory* const> blocks, std::minstd_rand& random);
  /// Grows where somebody who waits for an mbarrier may go on.
  std::uint64_t n_change() const { return n_change_; }

  /// Makes what a thread wrote visible to asynchronous reads, which need a barrier after it besides.
  void fence_async(int thread);
  /// A warp's asynchronous read of 16 bytes in a group of such, which are numbered from 0 in each block. Nobody may
  /// write there before the warp has waited for the group, and another warp not before a barrier after that.
  void async_read(std::size_t offset, int warp, std::uint32_t group);
  void async_done(int warp, std::uint32_t group);

  /// Counts what lanes wait for each other when they access `width` bytes at each offset: those of one bank, but for
  /// the same word, go one after the other. Up to 128 bytes are one transaction. Lanes with kNone take no part.
  static constexpr std::size_t kNone = ~std::size_t{0};
  static void count_conflicts(std::span<const std::size_t> offsets, std::size_t width);

 private:
  struct Event {
    int thread = -1;  // or, of readers, one of the values below
    std::uint64_t time = 0, warp_time = 0;
    std::size_t n_fence = 0;  // of that thread before it
    bool operator==(const Event&) const = default;
  };
  struct Word {
    Event write, read;
  };
  struct Copy {
    std::size_t offset;
    const void* from;
    std::size_t size;
  };
  /// A copy that an mbarrier counts.
  struct BulkCopy {
    std::size_t offset;
    std::vector<std::byte> bytes;
    std::size_t mbarrier;
    std::uint64_t phase;
    bool is_here;
  };
  /// An mbarrier, and who began it.
  struct Begun {
    Mbarrier mbarrier;
    Event begin;
    bool is_fenced;
    std::uint64_t n_awaited = 0;  // phases that other blocks have arrived in since the cluster's last barrier
  };
  static constexpr int kNobody = -1, kManyOfWarp = 1 << 20, kMany = 1 << 21;
  static constexpr int kBulk = 1 << 22;  // a writer: the bulk copy whose number its time is
  static constexpr std::size_t kMostWarps = 32, kMostMbarriers = 64, kAsyncRead = 16;
  static constexpr std::uint64_t kPending = ~std::uint64_t{0};

  /// size: a power of two.
  void check_range(std::size_t offset, std::size_t size) const;
  /// Whether an event is over for a thread: its own, or with a barrier in between.
  bool ordered(const Event& event, int thread) const {
    return event.thread == kNobody || (event.thread != kBulk && event.time < barrier_time_) ||
           ordered_without_barrier(event, thread);
  }
  bool ordered_without_barrier(const Event& event, int thread) const;
  /// Whether an event of this block is over for any thread that knows this.
  bool is_over(const Event& event, const Knowledge& knows) const;
  Knowledge& knowledge_of(int thread);
  void share_knowledge(std::size_t first_thread, std::size_t end);
  Begun& find_mbarrier(std::size_t offset, const SharedMemory& block, int thread);
  void check_no_mbarrier(std::size_t offset, std::size_t size) const;
  void check_bulk_copy(std::size_t word, const SharedMemory& block, int thread, const Knowledge& knows) const;
  void check_fence(const Event& write, int warp, const char* fault) const;
  void bring(std::size_t copy);
  void check_written(const Event& write, int warp) const;
  /// thread: -1 for one of another block.
  void check_async_readers(std::size_t word, int thread, const Knowledge* knows, const char* fault) const;
  void check_other_readers(std::size_t word) const;
  Event now(int thread) const {
    const auto t = static_cast<std::size_t>(thread);
    return {thread, time_, warp_time_[t / kWarp], fences_[t].size()};
  }
  void arrive(const Copy& copy, int thread);

  std::vector<std::byte> room_;
  std::byte* data_ = nullptr;
  std::size_t size_ = 0;
  std::vector<Word> words_;
  std::size_t rank_ = 0;
  std::uint64_t time_ = 1;  // barriers of this block and those before it, and its threads' arrivals at mbarriers
  std::uint64_t begin_time_ = 1, barrier_time_ = 1;                   // barrier_time_: after the last barrier
  std::vector<std::vector<std::uint64_t>> fences_;                    // of each thread: their times
  std::vector<std::vector<std::uint64_t>> async_done_;                // of each warp and group: its time
  std::vector<std::array<std::uint32_t, kMostWarps>> async_readers_;  // of 16 bytes and a warp: the last group, from 1
  std::vector<std::uint64_t> others_read_;    // of each word, when another block read it; empty until one has
  std::uint64_t cluster_time_ = 1;            // after the cluster's last barrier that released
  bool is_read_ = false, has_ended_ = false;  // is_read_: by another block since the cluster's last barrier
  std::map<std::size_t, Begun> mbarriers_;    // by their offsets
  std::vector<BulkCopy> bulk_copies_;
  std::vector<std::size_t> on_their_way_;  // of these
  std::vector<Knowledge> knowledge_;       // of each thread; empty until an mbarrier has begun
  Knowledge of_cluster_;                   // at the cluster's last barrier that released
  std::uint64_t n_change_ = 0;
  std::vector<std::uint64_t> warp_time_;
  std::vector<std::vector<Copy>> open_;                   // of each thread, since its last commit
  std::vector<std::deque<std::vector<Copy>>> committed_;  // the oldest group first
};

}  // namespace vla::test::cuda
