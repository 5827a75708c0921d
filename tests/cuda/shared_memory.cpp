// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/shared_memory.h"

#include <algorithm>
#include <cstring>

#include "cuda/device_memory.h"
#include "cuda/fault.h"

namespace vla::test::cuda {

void SharedMemory::begin(std::size_t size, int n_thread, std::size_t rank) {
  constexpr std::size_t kAlign = 1024;
  if (room_.size() < size + kAlign) room_.resize(size + kAlign);
  const auto at = reinterpret_cast<std::uintptr_t>(room_.data());
  data_ = room_.data() + (kAlign - at % kAlign) % kAlign, size_ = size;
  std::memset(data_, kGarbage, size);
  const auto has_copies = [](const auto& groups) { return !groups.empty(); };
  if (std::any_of(open_.begin(), open_.end(), has_copies) ||
      std::any_of(committed_.begin(), committed_.end(), has_copies) || !bulk_copies_.empty())
    words_.clear();  // copies of a block that ended without them, and those that have numbers
  if (words_.size() < (size + 3) / 4) words_.resize((size + 3) / 4);
  const auto n = static_cast<std::size_t>(n_thread);
  warp_time_.resize(std::max(warp_time_.size(), n / kWarp));
  open_.assign(n, {}), committed_.assign(n, {});
  fences_.assign(n, {}), async_done_.assign(n / kWarp, {}), async_readers_.clear();
  cluster_time_ = begin_time_ = barrier_time_ = ++time_;  // whatever the block before did is over
  others_read_.clear(), is_read_ = has_ended_ = false;
  rank_ = rank, n_change_ = 0, of_cluster_ = {};
  mbarriers_.clear(), bulk_copies_.clear(), on_their_way_.clear(), knowledge_.clear();
}

void SharedMemory::check_range(std::size_t offset, std::size_t size) const {
  if ((offset & (size - 1)) != 0) throw Fault("address in shared memory is not aligned");
  if (offset >= size_ || offset + size > size_) throw Fault("address is not in shared memory");
}

bool SharedMemory::ordered_without_barrier(const Event& event, int thread) const {
  if (!knowledge_.empty() && is_over(event, knowledge_[static_cast<std::size_t>(thread)])) return true;
  if (event.thread == kBulk || event.time == kPending || event.thread == kMany) return false;
  if (event.thread == thread) return true;
  const int warp = event.thread >= kManyOfWarp ? event.thread - kManyOfWarp : event.thread / kWarp;
  return warp == thread / kWarp && event.warp_time < warp_time_[static_cast<std::size_t>(warp)];
}

bool SharedMemory::is_over(const Event& event, const Knowledge& knows) const {
  if (event.thread == kBulk) {
    const BulkCopy& copy = bulk_copies_[event.time];
    return copy.is_here && knows.n_phase(copy.mbarrier) > copy.phase;
  }
  if (event.time == kPending || event.thread == kMany) return false;
  const int warp = event.thread >= kManyOfWarp ? event.thread - kManyOfWarp : event.thread / kWarp;
  const Knowledge::Arrival arrival = knows.arrival(rank_ * kMostWarps + static_cast<std::size_t>(warp));
  return (arrival.thread == event.thread && event.time <= arrival.time) || event.warp_time < arrival.warp_time;
}

void SharedMemory::barrier() {
  barrier_time_ = ++time_;
  share_knowledge(0, knowledge_.size());
}
void SharedMemory::warp_barrier(int warp) {
  const auto first = static_cast<std::size_t>(warp) * kWarp;
  ++warp_time_[first / kWarp];
  if (!knowledge_.empty()) share_knowledge(first, first + kWarp);
}
void SharedMemory::share_knowledge(std::size_t first_thread, std::size_t end) {
  if (first_thread == end) return;
  Knowledge all;
  for (std::size_t i = first_thread; i < end; ++i) all.learn(knowledge_[i]);
  for (std::size_t i = first_thread; i < end; ++i) knowledge_[i] = all;
}
Knowledge& SharedMemory::knowledge_of(int thread) {
  if (knowledge_.empty()) knowledge_.resize(open_.size());
  return knowledge_[static_cast<std::size_t>(thread)];
}

void SharedMemory::read(std::size_t offset, std::size_t size, int thread) {
  check_range(offset, size);
  check_no_mbarrier(offset, size);
  for (std::size_t i = offset / 4; i < (offset + size + 3) / 4; ++i) {
    Word& word = words_[i];
    if (word.write.thread == kBulk && !ordered(word.write, thread))
      throw Fault("reads what a bulk copy brings, for which it has not waited");
    if (word.write.time == kPending && word.write.thread != kNobody)
      throw Fault("reads what an asynchronous copy has not brought");
    if (!ordered(word.write, thread)) throw Fault("race in shared memory: reads what another thread writes");
    const int before = word.read.thread, warp = thread / kWarp;
    const bool alone = before == thread || ordered(word.read, thread);
    const bool of_warp = before >= kManyOfWarp ? before == kManyOfWarp + warp : before / kWarp == warp;
    word.read = now(thread);
    if (!alone) word.read.thread = of_warp ? kManyOfWarp + warp : kMany;
  }
}

void SharedMemory::write(std::size_t offset, std::size_t size, int thread) {
  check_range(offset, size);
  check_no_mbarrier(offset, size);
  const Knowledge* knows = knowledge_.empty() ? nullptr : &knowledge_of(thread);
  for (std::size_t i = offset / 4; i < (offset + size + 3) / 4; ++i) {
    Word& word = words_[i];
    if (!ordered(word.write, thread)) throw Fault("race in shared memory: writes what another thread or a copy writes");
    if (!ordered(word.read, thread)) throw Fault("race in shared memory: writes what another thread reads");
    if (!async_readers_.empty())
      check_async_readers(i, thread, knows, "race in shared memory: writes what wgmma reads");
    if (!others_read_.empty()) check_other_readers(i);
    word.write = now(thread);
  }
}

void SharedMemory::read_by_other(std::size_t offset, std::size_t size) {
  check_range(offset, size);
  if (has_ended_) throw Fault("reads shared memory of a block that has ended");
  if (cluster_time_ == begin_time_) throw Fault("reads shared memory of another block before a barrier of the cluster");
  others_read_.resize((size_ + 3) / 4);
  is_read_ = true;
  for (std::size_t i = offset / 4; i < (offset + size + 3) / 4; ++i) {
    const Event& write = words_[i].write;  // perhaps of a copy that has not arrived
    if (write.thread == kBulk ? !is_over(write, of_cluster_) : write.time >= cluster_time_)
      throw Fault("race in shared memory: reads what another block writes");
    others_read_[i] = time_;
  }
}

void SharedMemory::cluster_barrier(bool releases) {
  is_read_ = false;
  for (auto& [offset, begun] : mbarriers_) begun.n_awaited = 0;
  if (!releases) return;
  barrier();
  cluster_time_ = barrier_time_;
  if (!knowledge_.empty()) of_cluster_ = knowledge_[0];
}

void SharedMemory::end() {
  has_ended_ = true;
  if (is_read_) throw Fault("ends while another block of its cluster may read its shared memory");
  for (const auto& [offset, begun] : mbarriers_)
    if (begun.n_awaited > begun.mbarrier.n_waited()) throw Fault("ends while another block may arrive at its mbarrier");
  for (const BulkCopy& copy : bulk_copies_)
    for (const auto& [offset, begun] : mbarriers_)
      if (begun.mbarrier.number() == copy.mbarrier && begun.mbarrier.n_waited() <= copy.phase)
        throw Fault("ends before a bulk copy that nobody has waited for");
}

void SharedMemory::check_other_readers(std::size_t word) const {
  if (others_read_[word] >= cluster_time_) throw Fault("race in shared memory: writes what another block reads");
}

void SharedMemory::copy(std::size_t offset, const void* from, std::size_t size, int thread) {
  if (size > 16) throw Fault("an asynchronous copy of more than 16 bytes");
  write(offset, 16, thread);
  ++counts.copies;
  for (std::size_t i = offset / 4; i < offset / 4 + 4; ++i) words_[i].write.time = kPending;
  std::memset(data_ + offset, kGarbage, 16);
  open_[static_cast<std::size_t>(thread)].push_back({offset, from, size});
  if (!schedule.late_copies) {
    std::memset(data_ + offset, 0, 16);
    std::memcpy(data_ + offset, from, size);
  }
}

void SharedMemory::commit(int thread) {
  auto& open = open_[static_cast<std::size_t>(thread)];
  committed_[static_cast<std::size_t>(thread)].push_back(std::move(open));
  open.clear();
}

void SharedMemory::wait(std::size_t n_left, int thread) {
  auto& groups = committed_[static_cast<std::size_t>(thread)];
  for (; groups.size() > n_left; groups.pop_front())
    for (const Copy& copy : groups.front()) arrive(copy, thread);
}

void SharedMemory::arrive(const Copy& copy, int thread) {
  std::memset(data_ + copy.offset, 0, 16);
  std::memcpy(data_ + copy.offset, copy.from, copy.size);
  for (std::size_t i = copy.offset / 4; i < copy.offset / 4 + 4; ++i) words_[i].write = now(thread);
}

void SharedMemory::fence_async(int thread) { fences_[static_cast<std::size_t>(thread)].push_back(time_); }

void SharedMemory::async_read(std::size_t offset, int warp, std::uint32_t group) {
  check_range(offset, kAsyncRead);
  const auto of_warp = static_cast<std::size_t>(warp);
  if (of_warp >= kMostWarps) throw Fault("more warps than a block may have");
  async_readers_.resize((size_ + kAsyncRead - 1) / kAsyncRead);
  async_done_[of_warp].resize(group + 1, kPending);
  async_readers_[offset / kAsyncRead][of_warp] = group + 1;
  const Word* const first = &words_[offset / 4];
  for (const Word* word = first; word != first + kAsyncRead / 4; ++word)
    if (word == first || word->write != word[-1].write) check_written(word->write, warp);
}

/// Whether a warp's asynchronous read may see what was written.
void SharedMemory::check_written(const Event& write, int warp) const {
  if (write.thread == kBulk) {
    for (int lane = 0; lane < kWarp; ++lane)
      if (!ordered(write, warp * kWarp + lane))
        throw Fault("wgmma reads what a bulk copy brings, for which a lane has not waited");
    return;
  }
  if (write.thread == kNobody || write.time < begin_time_) return;
  if (write.time == kPending) throw Fault("wgmma reads what an asynchronous copy has not brought");
  if (!ordered(write, warp * kWarp)) throw Fault("race in shared memory: wgmma reads what another thread writes");
  check_fence(write, warp, "wgmma reads what no fence.proxy.async has made visible");
}
/// Whether a fence between a thread's write and now lets asynchronous accesses follow it: those of its warp, and of
/// others if a barrier came after the fence. warp: -1 for one of another block.
void SharedMemory::check_fence(const Event& write, int warp, const char* fault) const {
  const auto& fences = fences_[static_cast<std::size_t>(write.thread)];
  const bool is_own = write.thread / kWarp == warp;
  if (fences.size() <= write.n_fence || (!is_own && fences[write.n_fence] >= barrier_time_)) throw Fault(fault);
}

void SharedMemory::async_done(int warp, std::uint32_t group) {
  auto& done = async_done_[static_cast<std::size_t>(warp)];
  done.resize(std::max<std::size_t>(done.size(), group + 1), kPending);
  done[group] = time_;
}

void SharedMemory::check_async_readers(std::size_t word, int thread, const Knowledge* knows, const char* fault) const {
  for (std::size_t warp = 0; warp < async_done_.size(); ++warp) {
    const std::uint32_t group = async_readers_[word * 4 / kAsyncRead][warp];
    if (group == 0) continue;
    const std::uint64_t done = async_done_[warp][group - 1];
    const bool is_own = thread >= 0 && warp == static_cast<std::size_t>(thread / kWarp);
    const bool is_behind = done < (thread >= 0 ? barrier_time_ : cluster_time_);
    const bool is_known = knows != nullptr && knows->arrival(rank_ * kMostWarps + warp).time >= done;
    if (done == kPending || !(is_own || is_behind || is_known)) throw Fault(fault);
  }
}

void SharedMemory::begin_mbarrier(std::size_t offset, int n_arrival, int thread) {
  constexpr int kMostArrivals = (1 << 20) - 1;
  if (n_arrival < 1 || n_arrival > kMostArrivals) throw Fault("an mbarrier of so many arrivals");
  write(offset, 8, thread);
  knowledge_of(thread);
  const std::size_t number = rank_ * kMostMbarriers + mbarriers_.size();
  if (mbarriers_.size() == kMostMbarriers) throw Fault("more mbarriers than are known");
  mbarriers_.emplace(offset, Begun{Mbarrier(number, n_arrival), now(thread), false, 0});
}

void SharedMemory::fence_mbarriers(int thread) {
  for (auto& [offset, begun] : mbarriers_) begun.is_fenced |= begun.begin.thread == thread;
}

/// The mbarrier there, for a thread of a block. `thread` -1: a copy.
SharedMemory::Begun& SharedMemory::find_mbarrier(std::size_t offset, const SharedMemory& block, int thread) {
  check_range(offset, 8);
  const auto found = mbarriers_.find(offset);
  if (found == mbarriers_.end()) throw Fault("no mbarrier has begun there");
  Begun& begun = found->second;
  if (&block == this && !ordered(begun.begin, thread))
    throw Fault("race in shared memory: an mbarrier that another thread begins");
  if (&block == this) return begun;
  if (has_ended_) throw Fault("an mbarrier of a block that has ended");
  if (begun.begin.time >= cluster_time_) throw Fault("an mbarrier of another block before a barrier of the cluster");
  if (!begun.is_fenced) throw Fault("an mbarrier of another block that no fence has made visible");
  return begun;
}

void SharedMemory::check_no_mbarrier(std::size_t offset, std::size_t size) const {
  if (mbarriers_.empty()) return;
  const auto next = mbarriers_.lower_bound(offset < 7 ? 0 : offset - 7);
  if (next != mbarriers_.end() && next->first < offset + size) throw Fault("touches an mbarrier as plain memory");
}

void SharedMemory::arrive(std::size_t offset, std::int64_t n_byte, SharedMemory& block, int thread) {
  Begun& begun = find_mbarrier(offset, block, thread);
  if (&block != this) begun.n_awaited = begun.mbarrier.n_phase() + 1;
  Knowledge& knows = block.knowledge_of(thread);
  const auto warp = static_cast<std::size_t>(thread / kWarp);
  knows.learn(block.rank_ * kMostWarps + warp, {block.time_, block.warp_time_[warp], thread});
  ++block.time_, ++n_change_;
  begun.mbarrier.arrive(knows, n_byte);
}

bool SharedMemory::try_wait(std::size_t offset, unsigned parity, int thread) {
  const bool has_ended = find_mbarrier(offset, *this, thread).mbarrier.try_wait(parity, knowledge_of(thread));
  n_change_ += has_ended;
  return has_ended;
}

void SharedMemory::bulk_copy(std::size_t offset, const std::vector<std::byte>& bytes, std::size_t mbarrier,
                             SharedMemory& block, int thread) {
  if (offset % 128 != 0) throw Fault("a bulk copy to an address that is not aligned");
  if (offset + bytes.size() > size_) throw Fault("address is not in shared memory");
  check_no_mbarrier(offset, bytes.size());
  const Begun& counts_it = find_mbarrier(mbarrier, block, thread);
  if (!counts_it.is_fenced) throw Fault("an mbarrier that no fence has made visible to copies");
  const Knowledge& knows = block.knowledge_of(thread);
  const Event copied = {kBulk, bulk_copies_.size(), 0, 0};
  const std::size_t end = (offset + bytes.size()) / 4;
  for (std::size_t i = offset / 4; i < end; ++i) check_bulk_copy(i, block, thread, knows);
  for (std::size_t i = offset / 4; i < end; ++i) words_[i].write = copied;
  std::memset(data_ + offset, kGarbage, bytes.size());
  bulk_copies_.push_back({offset, bytes, counts_it.mbarrier.number(), counts_it.mbarrier.n_phase(), false});
  on_their_way_.push_back(copied.time);
  ++counts.copies;
  if (!schedule.late_copies) bring(copied.time);
}

/// Whether a bulk copy of a thread may write a word.
void SharedMemory::check_bulk_copy(std::size_t word, const SharedMemory& block, int thread,
                                   const Knowledge& knows) const {
  const bool is_own = &block == this;
  const auto comes_after = [&](const Event& event) {
    if (event.thread == kNobody || (event.thread != kBulk && event.time < begin_time_)) return true;
    if (is_own ? ordered(event, thread) : event.thread != kBulk && event.time < cluster_time_) return true;
    return is_over(event, knows) || (event.thread == kBulk && is_over(event, of_cluster_));
  };
  const Event& write = words_[word].write;
  if (!comes_after(write)) throw Fault("race in shared memory: a bulk copy writes what others write");
  if (!comes_after(words_[word].read)) throw Fault("race in shared memory: a bulk copy writes what a thread reads");
  if (write.thread != kNobody && write.thread != kBulk && write.time >= begin_time_)
    check_fence(write, is_own ? thread / kWarp : -1, "a bulk copy writes what was written without fence.proxy.async");
  if (word * 4 % kAsyncRead == 0 && !async_readers_.empty())
    check_async_readers(word, is_own ? thread : -1, &knows,
                        "race in shared memory: a bulk copy writes what wgmma reads");
}

void SharedMemory::bring(std::size_t number) {
  BulkCopy& copy = bulk_copies_[number];
  std::copy(copy.bytes.begin(), copy.bytes.end(), data_ + copy.offset);
  copy.is_here = true, ++n_change_;
  std::erase(on_their_way_, number);
  for (auto& [offset, begun] : mbarriers_)
    if (begun.mbarrier.number() == copy.mbarrier) begun.mbarrier.bring(static_cast<std::int64_t>(copy.bytes.size()));
  copy.bytes = {};
}

bool SharedMemory::bring_one(std::span<SharedMemory* const> blocks, std::minstd_rand& random) {
  std::vector<std::pair<SharedMemory*, std::size_t>> all;
  for (SharedMemory* block : blocks)
    for (const std::size_t copy : block->on_their_way_) all.emplace_back(block, copy);
  if (all.empty()) return false;
  const auto [block, copy] = all[schedule.seed != 0 ? random() % all.size() : 0];
  block->bring(copy);
  return true;
}

void SharedMemory::count_conflicts(std::span<const std::size_t> offsets, std::size_t width) {
  // The usual: one place for all lanes, or one place after the other.
  std::size_t same = 1, in_turn = 1;
  for (std::size_t i = 1; i < offsets.size(); ++i)
    same += offsets[i] == offsets[0], in_turn += offsets[i] == offsets[0] + i * width;
  if (offsets[0] != kNone && std::max(same, in_turn) == offsets.size()) return;
  const std::size_t at_once = std::min<std::size_t>(offsets.size(), 128 / std::max<std::size_t>(width, 4));
  for (std::size_t first = 0; first < offsets.size(); first += at_once) {
    std::size_t words[32][kWarp];  // of each bank, each once
    int in_bank[32] = {}, most = 1;
    for (std::size_t offset : offsets.subspan(first, std::min(at_once, offsets.size() - first)))
      for (std::size_t b = 0; offset != kNone && b < width; b += 4) {
        const std::size_t word = (offset + b) / 4, bank = word % 32;
        if (std::find(words[bank], words[bank] + in_bank[bank], word) != words[bank] + in_bank[bank]) continue;
        words[bank][in_bank[bank]++] = word, most = std::max(most, in_bank[bank]);
      }
    counts.bank_conflicts += most - 1;
  }
}

}  // namespace vla::test::cuda
