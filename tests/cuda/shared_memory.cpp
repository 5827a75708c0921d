// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/shared_memory.h"

#include <algorithm>
#include <cstring>

#include "cuda/device_memory.h"
#include "cuda/fault.h"

namespace vla::test::cuda {

void SharedMemory::begin(std::size_t size, int n_thread) {
  constexpr std::size_t kAlign = 1024;
  if (room_.size() < size + kAlign) room_.resize(size + kAlign);
  const auto at = reinterpret_cast<std::uintptr_t>(room_.data());
  data_ = room_.data() + (kAlign - at % kAlign) % kAlign, size_ = size;
  std::memset(data_, kGarbage, size);
  const auto has_copies = [](const auto& groups) { return !groups.empty(); };
  if (std::any_of(open_.begin(), open_.end(), has_copies) ||
      std::any_of(committed_.begin(), committed_.end(), has_copies))
    words_.clear();  // copies of a block that ended without them
  if (words_.size() < (size + 3) / 4) words_.resize((size + 3) / 4);
  const auto n = static_cast<std::size_t>(n_thread);
  warp_time_.resize(std::max(warp_time_.size(), n / kWarp));
  open_.assign(n, {}), committed_.assign(n, {});
  fences_.assign(n, {}), async_done_.assign(n / kWarp, {}), async_readers_.clear();
  cluster_time_ = begin_time_ = ++time_;  // whatever the block before did is over
  others_read_.clear(), is_read_ = has_ended_ = false;
}

void SharedMemory::check_range(std::size_t offset, std::size_t size) const {
  if ((offset & (size - 1)) != 0) throw Fault("address in shared memory is not aligned");
  if (offset >= size_ || offset + size > size_) throw Fault("address is not in shared memory");
}

bool SharedMemory::ordered_without_barrier(const Event& event, int thread) const {
  if (event.time == kPending || event.thread == kMany) return false;
  if (event.thread == thread) return true;
  const int warp = event.thread >= kManyOfWarp ? event.thread - kManyOfWarp : event.thread / kWarp;
  return warp == thread / kWarp && event.warp_time < warp_time_[static_cast<std::size_t>(warp)];
}

void SharedMemory::read(std::size_t offset, std::size_t size, int thread) {
  check_range(offset, size);
  for (std::size_t i = offset / 4; i < (offset + size + 3) / 4; ++i) {
    Word& word = words_[i];
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
  for (std::size_t i = offset / 4; i < (offset + size + 3) / 4; ++i) {
    Word& word = words_[i];
    if (!ordered(word.write, thread)) throw Fault("race in shared memory: writes what another thread or a copy writes");
    if (!ordered(word.read, thread)) throw Fault("race in shared memory: writes what another thread reads");
    if (!async_readers_.empty()) check_async_readers(i, thread);
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
    if (words_[i].write.time >= cluster_time_)  // also of a copy that has not arrived
      throw Fault("race in shared memory: reads what another block writes");
    others_read_[i] = time_;
  }
}

void SharedMemory::cluster_barrier(bool releases) {
  if (releases) cluster_time_ = ++time_;
  is_read_ = false;
}

void SharedMemory::end() {
  has_ended_ = true;
  if (is_read_) throw Fault("ends while another block of its cluster may read its shared memory");
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
  if (write.thread == kNobody || write.time < begin_time_) return;
  if (write.time == kPending) throw Fault("wgmma reads what an asynchronous copy has not brought");
  if (!ordered(write, warp * kWarp)) throw Fault("race in shared memory: wgmma reads what another thread writes");
  const auto& fences = fences_[static_cast<std::size_t>(write.thread)];
  const bool is_own = write.thread / kWarp == warp;
  if (fences.size() <= write.n_fence || (!is_own && fences[write.n_fence] >= time_))
    throw Fault("wgmma reads what no fence.proxy.async has made visible");
}

void SharedMemory::async_done(int warp, std::uint32_t group) {
  auto& done = async_done_[static_cast<std::size_t>(warp)];
  done.resize(std::max<std::size_t>(done.size(), group + 1), kPending);
  done[group] = time_;
}

void SharedMemory::check_async_readers(std::size_t word, int thread) const {
  for (std::size_t warp = 0; warp < async_done_.size(); ++warp) {
    const std::uint32_t group = async_readers_[word * 4 / kAsyncRead][warp];
    if (group == 0) continue;
    const std::uint64_t done = async_done_[warp][group - 1];
    const bool is_own = warp == static_cast<std::size_t>(thread / kWarp);
    if (done == kPending || (!is_own && done >= time_)) throw Fault("race in shared memory: writes what wgmma reads");
  }
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
