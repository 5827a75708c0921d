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
#include "cuda/tensor_map.h"
#include "cuda/wgmma.h"

namespace vla::test::cuda {
namespace {

std::map<std::string, const Entry*>& entries() {
  static std::map<std::string, const Entry*> all;
  return all;
}

struct Block;
struct Thread {
  Fiber fiber;
  int number = 0;
  Block* block = nullptr;
};
/// Registers of wgmma, and where each lane has them.
struct Sums : WgmmaRegisters {
  std::uint32_t* lanes[kWarp];
};
struct OperandA : WgmmaRegisters {
  const std::uint32_t* lanes[kWarp];
};
struct Warp {
  Meeting* lanes[kWarp] = {};
  int n_here = 0;
  Meeting::Kind kind = Meeting::kSync;  // what the lanes that are here came to
  Wgmma wgmma = {};
  std::list<Sums> sums = {};          // in flight
  std::list<OperandA> operands = {};  // likewise
};
/// A block of the cluster that runs.
struct Block {
  std::vector<std::unique_ptr<Thread>> threads;
  std::vector<Warp> warps;
  std::vector<Thread*> at_barrier;
  SharedMemory shared;
  unsigned z = 0;
  std::size_t n_done = 0;
};
/// The cluster that runs; most have one block.
struct Cluster {
  std::vector<std::unique_ptr<Block>> blocks;  // the first n_block of them run
  std::size_t n_block = 0, n_thread = 0, n_done = 0;
  std::vector<Thread*> ready;  // the last one goes on first, so that a warp runs until it waits for another
  std::vector<Thread*> at_barrier, at_mbarrier;
  std::uint64_t n_change = 0;  // of its mbarriers, when threads that wait for one last went on
  bool releases = true;        // that barrier
  Fiber main;
  Thread* self = nullptr;
  std::minstd_rand random;
  const Entry* entry = nullptr;
  const void* job = nullptr;
  std::string fault;
};
Cluster cluster;

Block& own_block() { return *cluster.self->block; }
Warp& own_warp() { return own_block().warps[static_cast<std::size_t>(cluster.self->number / kWarp)]; }

void release(std::vector<Thread*> threads) {
  if (schedule.seed) std::shuffle(threads.begin(), threads.end(), cluster.random);
  cluster.ready.insert(cluster.ready.end(), threads.rbegin(), threads.rend());
}

/// Where all wait, those that wait for mbarriers look again, once something has changed. If nothing has, a copy
/// arrives.
void look_again() {
  if (!cluster.ready.empty() || cluster.at_mbarrier.empty() || !cluster.fault.empty()) return;
  std::vector<SharedMemory*> blocks;
  const auto n_change = [&] {
    std::uint64_t n = 0;
    for (const SharedMemory* block : blocks) n += block->n_change();
    return n;
  };
  for (std::size_t i = 0; i < cluster.n_block; ++i) blocks.push_back(&cluster.blocks[i]->shared);
  if (n_change() == cluster.n_change && !SharedMemory::bring_one(blocks, cluster.random)) {
    cluster.fault = "waits for a phase of an mbarrier that never comes";
    return;
  }
  cluster.n_change = n_change();
  release(std::exchange(cluster.at_mbarrier, {}));
}

/// Another thread goes on, or the launch where none can.
void go_on(Fiber& from) {
  try {
    look_again();
  } catch (const Fault& problem) {
    cluster.fault = problem.what();
  }
  if (cluster.ready.empty() && cluster.fault.empty() && cluster.n_done < cluster.n_thread)
    cluster.fault = cluster.at_barrier.empty()
                        ? "every thread waits: some came to another barrier or instruction of a warp, or ended"
                        : "some threads wait at a barrier of the cluster, others elsewhere, or they ended";
  if (cluster.ready.empty() || !cluster.fault.empty()) {
    if (&from != &cluster.main) from.switch_to(cluster.main);
    return;
  }
  Thread* next = cluster.ready.back();
  cluster.ready.pop_back();
  cluster.self = next;
  threadIdx.x = static_cast<unsigned>(next->number), blockIdx.z = next->block->z;
  if (&next->fiber != &from) from.switch_to(next->fiber);
}

void thread_main() {
  Thread& self = *cluster.self;
  self.fiber.arrived();
  try {
    cluster.entry->run(cluster.job);
    own_warp().wgmma.end();
    if (++self.block->n_done == self.block->threads.size()) self.block->shared.end();
  } catch (const Fault& problem) {
    if (cluster.fault.empty()) cluster.fault = problem.what();
  }
  ++cluster.n_done;
  go_on(self.fiber);
  std::abort();  // nobody comes back here
}

/// Begins a block, whose threads join `all`.
void begin_block(Block& block, unsigned z, int n_thread, std::size_t shared, std::vector<Thread*>& all) {
  const auto n = static_cast<std::size_t>(n_thread);
  while (block.threads.size() < n) block.threads.push_back(std::make_unique<Thread>());
  block.threads.resize(n);
  block.warps.clear();
  block.warps.resize(n / kWarp);
  block.at_barrier.clear();
  block.z = z, block.n_done = 0;
  block.shared.begin(shared, n_thread, z % cluster.n_block);
  for (std::size_t i = 0; i < block.warps.size(); ++i) block.warps[i].wgmma.begin(block.shared, static_cast<int>(i));
  for (std::size_t i = 0; i < n; ++i) {
    block.threads[i]->number = static_cast<int>(i), block.threads[i]->block = &block;
    block.threads[i]->fiber.begin(thread_main);
    all.push_back(block.threads[i].get());
  }
}

/// Runs the blocks from z on that are a cluster.
void run_cluster(unsigned z, std::size_t n_block, int n_thread, std::size_t shared) {
  while (cluster.blocks.size() < n_block) cluster.blocks.push_back(std::make_unique<Block>());
  cluster.ready.clear(), cluster.at_barrier.clear(), cluster.at_mbarrier.clear(), cluster.fault.clear();
  cluster.n_block = n_block, cluster.n_change = 0;
  std::vector<Thread*> all;
  for (std::size_t i = 0; i < n_block; ++i)
    begin_block(*cluster.blocks[i], z + static_cast<unsigned>(i), n_thread, shared, all);
  cluster.n_thread = all.size(), cluster.n_done = 0;
  release(all);
  go_on(cluster.main);
  if (!cluster.fault.empty())
    throw Fault(std::string(cluster.entry->name) + ", block " + std::to_string(blockIdx.x) + "," +
                std::to_string(blockIdx.y) + "," + std::to_string(blockIdx.z) + ", thread " +
                std::to_string(threadIdx.x) + ": " + cluster.fault);
  for (std::size_t i = 0; i < n_block; ++i) {
    std::vector<const Wgmma*> warps;
    for (const Warp& warp : cluster.blocks[i]->warps) warps.push_back(&warp.wgmma);
    check_warpgroups(warps);
  }
}

bool comes_before(const Thread* a, const Thread* b) {
  return std::pair(a->block->z, a->number) < std::pair(b->block->z, b->number);
}
/// All that have come to a barrier go on.
void go_through(std::vector<Thread*>& at_barrier) {
  std::sort(at_barrier.begin(), at_barrier.end(), comes_before);
  release(std::exchange(at_barrier, {}));
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
  cluster.entry = &entry, cluster.job = job;
  cluster.random.seed(schedule.seed);
  gridDim = {grid.x, grid.y, grid.z}, blockDim = {n_thread, 1, 1};
  for (unsigned z = 0; z < grid.z; z += grid.cluster)
    for (blockIdx.y = 0; blockIdx.y < grid.y; ++blockIdx.y)
      for (blockIdx.x = 0; blockIdx.x < grid.x; ++blockIdx.x)
        run_cluster(z, grid.cluster, static_cast<int>(n_thread), shared);
}

void fault(const char* what) { throw Fault(what); }

void barrier() {
  Block& block = own_block();
  if (cluster.self->number == 0) ++counts.barriers;
  block.at_barrier.push_back(cluster.self);
  if (block.at_barrier.size() == block.threads.size()) block.shared.barrier(), go_through(block.at_barrier);
  go_on(cluster.self->fiber);
}

void cluster_barrier(bool releases) {
  cluster.releases = releases && (cluster.releases || cluster.at_barrier.empty());
  cluster.at_barrier.push_back(cluster.self);
  if (cluster.at_barrier.size() == cluster.n_thread) {
    for (std::size_t i = 0; i < cluster.n_block; ++i) cluster.blocks[i]->shared.cluster_barrier(cluster.releases);
    go_through(cluster.at_barrier);
  }
  go_on(cluster.self->fiber);
}

std::byte* shared_memory() { return own_block().shared.data(); }
int lane_index() { return cluster.self->number % kWarp; }

void check_shared(const std::byte* p, std::size_t size, bool writes) {
  SharedMemory& shared = own_block().shared;
  const std::size_t at = shared.offset(p);
  writes ? shared.write(at, size, cluster.self->number) : shared.read(at, size, cluster.self->number);
}
namespace {
Block& block_of_rank(int rank) {
  if (rank < 0 || static_cast<std::size_t>(rank) >= cluster.n_block) fault("the cluster has no such block");
  return *cluster.blocks[static_cast<std::size_t>(rank)];
}
}  // namespace
const std::byte* of_block(const std::byte* p, std::size_t size, int rank) {
  Block &own = own_block(), &other = block_of_rank(rank);
  const std::size_t at = own.shared.offset(p);
  &own == &other ? own.shared.read(at, size, cluster.self->number) : other.shared.read_by_other(at, size);
  return other.shared.data() + at;
}
void copy_async(std::byte* to, const void* from, std::size_t size) {
  if (reinterpret_cast<std::uintptr_t>(from) % 16 != 0) fault("source of an asynchronous copy is not aligned");
  SharedMemory& shared = own_block().shared;
  shared.copy(shared.offset(to), from, size, cluster.self->number);
}
void commit_copies() { own_block().shared.commit(cluster.self->number); }
void wait_copies(std::size_t n_left) { own_block().shared.wait(n_left, cluster.self->number); }

unsigned shared_address(const std::byte* p) { return static_cast<unsigned>(own_block().shared.offset(p)); }
void fence_async_proxy() { own_block().shared.fence_async(cluster.self->number); }

void begin_mbarrier(std::byte* mbarrier, int n_arrival) {
  SharedMemory& shared = own_block().shared;
  shared.begin_mbarrier(shared.offset(mbarrier), n_arrival, cluster.self->number);
}
void fence_mbarriers() { own_block().shared.fence_mbarriers(cluster.self->number); }
void arrive(std::byte* mbarrier, int n_byte) {
  SharedMemory& shared = own_block().shared;
  shared.arrive(shared.offset(mbarrier), n_byte, shared, cluster.self->number);
}
void arrive_at_block(std::byte* mbarrier, int rank) {
  SharedMemory& shared = own_block().shared;
  block_of_rank(rank).shared.arrive(shared.offset(mbarrier), 0, shared, cluster.self->number);
}
void wait_mbarrier(std::byte* mbarrier, unsigned parity) {
  SharedMemory& shared = own_block().shared;
  while (!shared.try_wait(shared.offset(mbarrier), parity, cluster.self->number)) {
    cluster.at_mbarrier.push_back(cluster.self);
    go_on(cluster.self->fiber);
  }
}
void copy_box(std::byte* to, const void* map, std::span<const int> place, std::byte* mbarrier, unsigned blocks) {
  SharedMemory& shared = own_block().shared;
  const std::size_t at = shared.offset(to);
  const std::vector<std::byte> box = copy_box(
      map, place, at, [](std::uintptr_t from, std::size_t) { return reinterpret_cast<const std::byte*>(from); });
  const auto copy = [&](SharedMemory& block) {
    block.bulk_copy(at, box, shared.offset(mbarrier), shared, cluster.self->number);
  };
  if (blocks == 0) copy(shared);
  for (int rank = 0; blocks >> rank != 0; ++rank)
    if (blocks >> rank & 1) copy(block_of_rank(rank).shared);
}

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
/// Keeps what is in the lanes' registers of operand a, if it is there.
OperandA* operand_of(Warp& warp, Meeting* const* lanes) {
  if (!lanes[0]->product->a_in_registers) return nullptr;
  OperandA& made = warp.operands.emplace_back();
  made.of.resize(4);
  for (std::size_t l = 0; l < kWarp; ++l) {
    made.lanes[l] = lanes[l]->a;
    for (std::size_t i = 0; i < made.of.size(); ++i) made.of[i][l] = lanes[l]->a[i];
  }
  return &made;
}
void give_back(Warp& warp) {
  for (const OperandA& a : warp.operands)
    for (std::size_t l = 0; l < kWarp && a.n_product == 0; ++l)
      for (std::size_t i = 0; i < a.of.size(); ++i)
        if (a.lanes[l][i] != a.of[i][l]) fault("writes registers of wgmma that it has not waited for");
  std::erase_if(warp.operands, [](const OperandA& a) { return a.n_product == 0; });
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
  Block& block = own_block();
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
      return of.wgmma.issue(*lanes[0]->product, sums_of(of, lanes), operand_of(of, lanes));
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
  Block& block = own_block();
  Warp& warp = own_warp();
  const int lane = lane_index(), first = cluster.self->number - lane;
  if (warp.n_here == 0) warp.kind = mine.kind;
  if (warp.kind != mine.kind) fault("lanes of a warp came to different instructions");
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
  go_on(cluster.self->fiber);
}

}  // namespace vla::test::cuda
