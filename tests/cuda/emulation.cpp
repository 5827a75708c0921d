// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/emulation.h"

#include <algorithm>
#include <list>
#include <map>
#include <memory>
#include <random>
#include <string>
#include <utility>
#include <vector>

#include "cuda/device_memory.h"
#include "cuda/fault.h"
#include "cuda/fiber.h"
#include "cuda/fragments.h"
#include "cuda/wgmma.h"

namespace vla::test::cuda {
namespace {

std::map<std::string, const Entry*>& entries() {
  static std::map<std::string, const Entry*> all;
  return all;
}

struct Thread {
  Fiber fiber;
  int number = 0;
};
/// Sums of wgmma, and where each lane has them.
struct Sums : WgmmaSums {
  std::uint32_t* lanes[kWarp];
};
struct Warp {
  Meeting* lanes[kWarp] = {};
  int n_here = 0;
  Wgmma wgmma = {};
  std::list<Sums> sums = {};  // in flight
};
/// The block that runs.
struct Block {
  std::vector<std::unique_ptr<Thread>> threads;
  std::vector<Warp> warps;
  std::vector<Thread*> ready;  // the last one goes on first, so that a warp runs until it waits for another
  std::vector<Thread*> at_barrier;
  SharedMemory shared;
  Fiber main;
  Thread* self = nullptr;
  int n_done = 0;
  std::minstd_rand random;
  const Entry* entry = nullptr;
  const void* job = nullptr;
  std::string fault;

  Warp& warp() { return warps[static_cast<std::size_t>(self->number / kWarp)]; }
};
Block block;

/// Another thread goes on, or the launch where none can.
void go_on(Fiber& from) {
  if (block.ready.empty() && block.fault.empty() && block.n_done < static_cast<int>(block.threads.size()))
    block.fault = "every thread waits: some came to another barrier or instruction of a warp, or ended";
  if (block.ready.empty() || !block.fault.empty()) {
    if (&from != &block.main) from.switch_to(block.main);
    return;
  }
  Thread* next = block.ready.back();
  block.ready.pop_back();
  block.self = next;
  threadIdx.x = static_cast<unsigned>(next->number);
  if (&next->fiber != &from) from.switch_to(next->fiber);
}

void release(std::vector<Thread*> threads) {
  if (schedule.seed) std::shuffle(threads.begin(), threads.end(), block.random);
  block.ready.insert(block.ready.end(), threads.rbegin(), threads.rend());
}

void thread_main() {
  Thread& self = *block.self;
  self.fiber.arrived();
  try {
    block.entry->run(block.job);
    block.warp().wgmma.end();
  } catch (const Fault& problem) {
    if (block.fault.empty()) block.fault = problem.what();
  }
  ++block.n_done;
  go_on(self.fiber);
  std::abort();  // nobody comes back here
}

void run_block(int n_thread, std::size_t shared) {
  const auto n = static_cast<std::size_t>(n_thread);
  while (block.threads.size() < n) block.threads.push_back(std::make_unique<Thread>());
  block.threads.resize(n);
  block.warps.clear();
  block.warps.resize(n / kWarp);
  block.ready.clear(), block.at_barrier.clear(), block.fault.clear();
  block.n_done = 0;
  block.shared.begin(shared, n_thread);
  for (std::size_t i = 0; i < block.warps.size(); ++i) block.warps[i].wgmma.begin(block.shared, static_cast<int>(i));
  std::vector<Thread*> all;
  for (std::size_t i = 0; i < n; ++i) {
    block.threads[i]->number = static_cast<int>(i);
    block.threads[i]->fiber.begin(thread_main);
    all.push_back(block.threads[i].get());
  }
  release(all);
  go_on(block.main);
  if (block.fault.empty()) {
    std::vector<const Wgmma*> warps;
    for (const Warp& warp : block.warps) warps.push_back(&warp.wgmma);
    return check_warpgroups(warps);
  }
  throw Fault(std::string(block.entry->name) + ", block " + std::to_string(blockIdx.x) + "," +
              std::to_string(blockIdx.y) + "," + std::to_string(blockIdx.z) + ", thread " +
              std::to_string(threadIdx.x) + ": " + block.fault);
}

}  // namespace

Entry::Entry(const char* name_, int max_thread_, std::size_t job_size_, void (*run_)(const void*))
    : name(name_), max_thread(max_thread_), job_size(job_size_), run(run_) {
  entries()[name] = this;
}
const Entry* find_entry(const char* name) {
  const auto found = entries().find(name);
  return found == entries().end() ? nullptr : found->second;
}

void run_entry(const Entry& entry, Extent grid, unsigned n_thread, std::size_t shared, const void* job) {
  if (n_thread % kWarp != 0 || static_cast<int>(n_thread) > entry.max_thread)
    throw Fault(std::string(entry.name) + ": " + std::to_string(n_thread) +
                " threads are not whole warps, or too many");
  block.entry = &entry, block.job = job;
  block.random.seed(schedule.seed);
  gridDim = {grid.x, grid.y, grid.z}, blockDim = {n_thread, 1, 1};
  for (blockIdx.z = 0; blockIdx.z < grid.z; ++blockIdx.z)
    for (blockIdx.y = 0; blockIdx.y < grid.y; ++blockIdx.y)
      for (blockIdx.x = 0; blockIdx.x < grid.x; ++blockIdx.x) run_block(static_cast<int>(n_thread), shared);
}

void fault(const char* what) { throw Fault(what); }

void barrier() {
  if (block.self->number == 0) ++counts.barriers;
  block.at_barrier.push_back(block.self);
  if (block.at_barrier.size() == block.threads.size()) {
    block.shared.barrier();
    std::sort(block.at_barrier.begin(), block.at_barrier.end(), [](auto* a, auto* b) { return a->number < b->number; });
    release(std::move(block.at_barrier));
    block.at_barrier.clear();
  }
  go_on(block.self->fiber);
}

std::byte* shared_memory() { return block.shared.data(); }
int lane_index() { return block.self->number % kWarp; }

void check_shared(const std::byte* p, std::size_t size, bool writes) {
  const std::size_t at = block.shared.offset(p);
  writes ? block.shared.write(at, size, block.self->number) : block.shared.read(at, size, block.self->number);
}
void copy_async(std::byte* to, const void* from, std::size_t size) {
  if (reinterpret_cast<std::uintptr_t>(from) % 16 != 0) fault("source of an asynchronous copy is not aligned");
  block.shared.copy(block.shared.offset(to), from, size, block.self->number);
}
void commit_copies() { block.shared.commit(block.self->number); }
void wait_copies(std::size_t n_left) { block.shared.wait(n_left, block.self->number); }

unsigned shared_address(const std::byte* p) { return static_cast<unsigned>(block.shared.offset(p)); }
void fence_async_proxy() { block.shared.fence_async(block.self->number); }

namespace {

/// Takes the lanes' sums over, which hold garbage until they are given back.
Sums& sums_of(Warp& warp, Meeting* const* lanes) {
  for (Sums& sums : warp.sums)
    if (sums.lanes[0] == lanes[0]->to) return sums;
  Sums& made = warp.sums.emplace_back();
  made.of.resize(static_cast<std::size_t>(lanes[0]->product->n / 2));
  for (std::size_t l = 0; l < kWarp; ++l) {
    made.lanes[l] = lanes[l]->to;
    for (std::size_t i = 0; i < made.of.size(); ++i) made.of[i][l] = std::exchange(made.lanes[l][i], ~0U);
  }
  return made;
}
void give_back(Warp& warp) {
  for (const Sums& sums : warp.sums)
    for (std::size_t l = 0; l < kWarp && sums.n_product == 0; ++l)
      for (std::size_t i = 0; i < sums.of.size(); ++i) sums.lanes[l][i] = sums.of[i][l];
  std::erase_if(warp.sums, [](const Sums& sums) { return sums.n_product == 0; });
}

/// Registers of all lanes, one after the other.
template <int kCount>
struct Registers {
  Lanes of[kCount];
  Registers(Meeting* const* lanes, const std::uint32_t* Meeting::*which) {
    for (int i = 0; i < kCount; ++i)
      for (int l = 0; l < kWarp; ++l) of[i][l] = (lanes[l]->*which)[i];
  }
};

void compute(Meeting* const* lanes, int warp) {
  Warp& of = block.warps[static_cast<std::size_t>(warp)];
  Lanes to[4], sum[4];
  const auto results = [&] {
    for (int i = 0; i < 4; ++i)
      for (int l = 0; l < kWarp; ++l) lanes[l]->to[i] = to[i][l];
  };
  switch (lanes[0]->kind) {
    case Meeting::kSync:
      return block.shared.warp_barrier(warp);
    case Meeting::kShuffle:
      for (int l = 0; l < kWarp; ++l) *lanes[l]->to = *lanes[lanes[l]->lane & 31]->a;
      return;
    case Meeting::kMatrices:
    case Meeting::kTransposed: {
      std::size_t rows[kWarp];
      for (int l = 0; l < kWarp; ++l) rows[l] = block.shared.offset(lanes[l]->row);
      load_matrices(to, rows, lanes[0]->kind == Meeting::kTransposed, block.shared, warp);
      return results();
    }
    case Meeting::kS8:
    case Meeting::kBf16: {
      const Registers<4> a(lanes, &Meeting::a);
      const Registers<2> b(lanes, &Meeting::b);
      for (int i = 0; i < 4; ++i)
        for (int l = 0; l < kWarp; ++l) sum[i][l] = lanes[l]->to[i];
      (lanes[0]->kind == Meeting::kS8 ? mma_s8 : mma_bf16)(to, a.of, b.of, sum);
      return results();
    }
    case Meeting::kWgmma:
      for (int l = 1; l < kWarp; ++l)
        if (*lanes[l]->product != *lanes[0]->product) fault("lanes of a warp issue different products");
      return of.wgmma.issue(*lanes[0]->product, sums_of(of, lanes));
    case Meeting::kWgmmaFence:
      return of.wgmma.fence();
    case Meeting::kWgmmaCommit:
      return of.wgmma.commit();
    case Meeting::kWgmmaWait:
      of.wgmma.wait(lanes[0]->n_left);
      return give_back(of);
  }
}

}  // namespace

void meet(Meeting& mine) {
  Warp& warp = block.warp();
  const int lane = lane_index(), first = block.self->number - lane;
  for (const Meeting* other : warp.lanes)
    if (other != nullptr && other->kind != mine.kind) fault("lanes of a warp came to different instructions");
  warp.lanes[lane] = &mine;
  if (++warp.n_here == kWarp) {
    Meeting* lanes[kWarp];
    std::copy(warp.lanes, warp.lanes + kWarp, lanes);
    std::fill(warp.lanes, warp.lanes + kWarp, nullptr), warp.n_here = 0;
    compute(lanes, first / kWarp);
    std::vector<Thread*> all;
    for (int l = 0; l < kWarp; ++l) all.push_back(block.threads[static_cast<std::size_t>(first + l)].get());
    release(std::move(all));
  }
  go_on(block.self->fiber);
}

}  // namespace vla::test::cuda
