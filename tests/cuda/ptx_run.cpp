// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <bit>
#include <random>
#include <span>

#include "cuda/fault.h"
#include "cuda/ptx_warp.h"

namespace vla::test::cuda {
namespace {

/// The next group of lanes that go on where lanes have parted: those least far, unless they wait for the others.
u32 next_group(WarpState& w) {
  while (true) {
    int least = -1;
    bool same = true;
    for (int l = 0; l < kWarp; ++l) {
      if (!(w.live >> l & 1)) continue;
      same &= w.pcs[l] == w.pcs[std::countr_zero(w.live)];
      if (!(w.waits >> l & 1) && (least < 0 || w.pcs[l] < least)) least = w.pcs[l];
    }
    if (same) {
      w.together = true, w.waits = 0, w.pc = w.pcs[std::countr_zero(w.live)];
      return w.live;
    }
    if (least < 0) throw Fault("lanes of a warp came to different instructions");
    u32 group = 0;
    for (int l = 0; l < kWarp; ++l) group |= static_cast<u32>((w.live & ~w.waits) >> l & 1 && w.pcs[l] == least) << l;
    w.pc = least;
    return group;
  }
}

/// More instructions than any warp of the tests needs.
constexpr long kForever = 50'000'000;

/// Where a warp or a block has stopped: at its end, at a barrier of the block or of the cluster, or at an mbarrier,
/// where it looks again at its next turn.
using Stop = WarpState::Stop;

/// Runs a warp until it stops.
Stop run_warp(WarpState& w, const PtxKernel& kernel) {
  while (w.live != 0) {
    const u32 group = w.together ? w.live : next_group(w);
    const PtxInstruction& i = kernel.code.at(static_cast<std::size_t>(w.pc));
    u32 active = group;
    if (i.has_guard) active &= i.guard_is_not ? ~w.mask(i.guard) : w.mask(i.guard);
    ++counts.instructions;
    if (++w.n_done > kForever) throw Fault("a warp does not come to an end");
    if ((w.arrival != WarpState::kAway) != (i.kind == PtxInstruction::kCluster))
      throw Fault("arrives at a barrier of the cluster and does not wait there, or the other way round: " + i.text);
    int next = w.pc + 1;
    u32 jumps = 0;
    switch (i.kind) {
      case PtxInstruction::kPlain:
        w.active = active;
        if (active != 0 && (w.in_flight.empty() || !renames(w, i))) i.run(w, i);
        if (i.makes_operand) w.unfenced.insert(i.operand[0]);
        break;
      case PtxInstruction::kBranch:
        jumps = active;
        break;
      case PtxInstruction::kReturn:
        w.wgmma.end();
        if (w.early & active) throw Fault("ends without having waited for earlier kernels");
        w.live &= ~active;
        break;
      case PtxInstruction::kBarrier:
      case PtxInstruction::kCluster:
      case PtxInstruction::kWarp:
        if (active != kAll) {
          if (w.live != kAll || i.has_guard)
            throw Fault("some lanes come to an instruction of the whole warp: " + i.text);
          w.waits |= group;
          continue;
        }
        w.active = kAll;
        if (i.kind == PtxInstruction::kWarp) {
          i.run(w, i);
        } else {
          w.pc = next;
          return i.kind == PtxInstruction::kBarrier ? Stop::barrier : Stop::cluster;
        }
    }
    const u32 stay = group & ~jumps & w.live;
    if (w.together && (jumps == 0 || stay == 0)) {
      w.pc = jumps != 0 ? i.target : next;
    } else {
      w.together = false;
      for (int l = 0; l < kWarp; ++l)
        if (group >> l & 1) w.pcs[l] = jumps >> l & 1 ? i.target : next;
    }
    if (std::exchange(w.waits_for_phase, false)) return Stop::mbarrier;
  }
  return Stop::end;
}

struct BlockIndex {
  unsigned x, y, z;
};
struct Block {
  BlockIndex at;
  SharedMemory shared;
  std::vector<WarpState> warps;
  std::vector<WarpState*> order;
  std::uint32_t number;  // to device_memory()
  Stop stop;
};
/// The cluster that runs; most have one block.
struct Cluster {
  const PtxKernel& kernel;
  Extent grid;
  unsigned n_thread;
  std::span<Block> blocks;
  std::vector<SharedMemory*> shared;  // of each block
  std::minstd_rand random;
  BlockIndex at;  // of the block whose turn it is
};

void begin_block(const Cluster& cluster, Block& block, BlockIndex at, std::size_t n_shared, const void* job) {
  const PtxKernel& kernel = cluster.kernel;
  const Extent& grid = cluster.grid;
  const unsigned n_thread = cluster.n_thread;
  const std::size_t dynamic = (kernel.static_shared + 1023) / 1024 * 1024;
  SharedMemory& shared = block.shared;
  shared.begin(dynamic + n_shared, static_cast<int>(n_thread), at.z % grid.cluster);
  block.at = at, block.number = device_memory().begin_block(), block.stop = Stop::none;
  block.warps.resize(n_thread / kWarp), block.order.clear();
  for (std::size_t i = 0; i < block.warps.size(); ++i) {
    WarpState& w = block.warps[i];
    block.order.push_back(&w);
    w.live = kAll, w.waits = 0, w.early = kernel.overlaps ? kAll : 0, w.together = true, w.pc = 0, w.n_done = 0;
    w.number = static_cast<int>(i), w.job = static_cast<const std::byte*>(job), w.job_size = kernel.param_size;
    w.shared = &shared, w.cluster = cluster.shared, w.arrival = WarpState::kAway;
    w.stop = Stop::none, w.waits_for_phase = false;
    w.wgmma.begin(shared, w.number), w.in_flight.clear(), w.wgmma_registers.clear();
    w.unfenced.clear();
    w.registers.resize(kernel.register_bytes);
    std::copy(kernel.constants.begin(), kernel.constants.end(), w.registers.begin());
    for (const PtxKernel::Special& special : kernel.specials) {
      u32* to = w.lanes<u32>(special.place);
      const u32 values[] = {0, at.x, at.y, at.z, n_thread, grid.x, grid.y, grid.z, 0};
      for (int l = 0; l < kWarp; ++l)
        to[l] = special.which == 0   ? static_cast<u32>(w.thread(l))
                : special.which == 8 ? static_cast<u32>(l)
                                     : values[special.which];
    }
    for (const PtxKernel::SharedAddress& address : kernel.dynamic_shared)
      for (int l = 0; l < kWarp; ++l)
        address.wide ? void(w.lanes<u64>(address.place)[l] = dynamic)
                     : void(w.lanes<u32>(address.place)[l] = static_cast<u32>(dynamic));
  }
}

/// Runs a block until all its warps have stopped. Those that wait for an mbarrier have a turn each.
void run_block(Cluster& cluster, Block& block) {
  cluster.at = block.at;
  device_memory().go_on(block.number);
  if (schedule.seed) std::shuffle(block.order.begin(), block.order.end(), cluster.random);
  bool waits_for_phase = false;
  for (WarpState* w : block.order) {
    if (w->stop == Stop::none || w->stop == Stop::mbarrier) w->stop = run_warp(*w, cluster.kernel);
    waits_for_phase |= w->stop == Stop::mbarrier;
  }
  block.stop = waits_for_phase ? Stop::mbarrier : block.order[0]->stop;
  if (waits_for_phase) return;
  for (const WarpState* w : block.order)
    if (w->stop != block.stop)
      throw Fault(w->stop == Stop::end || block.stop == Stop::end ? "some threads end while others wait at a barrier"
                                                                  : "threads of a block wait at different barriers");
  if (block.stop == Stop::barrier) {
    block.shared.barrier(), ++counts.barriers;
    for (WarpState& w : block.warps) w.stop = Stop::none;
  }
  if (block.stop != Stop::end) return;
  std::vector<const Wgmma*> products;
  for (const WarpState& w : block.warps) products.push_back(&w.wgmma);
  check_warpgroups(products);
  block.shared.end();
}

/// All blocks stand at a barrier of the cluster, and go on. It releases if every thread's arrival does.
void meet(Cluster& cluster) {
  bool releases = true;
  for (Block& block : cluster.blocks)
    for (WarpState& w : block.warps) {
      releases &= std::exchange(w.arrival, WarpState::kAway) == WarpState::kReleased;
      w.stop = Stop::none;
    }
  for (Block& block : cluster.blocks) block.shared.cluster_barrier(releases), block.stop = Stop::none;
}

void run_cluster(Cluster& cluster) {
  std::vector<Block*> turns;
  for (Block& block : cluster.blocks) turns.push_back(&block);
  const auto stands = [&](Stop stop) {
    return std::ranges::count(turns, stop, &Block::stop) == static_cast<std::ptrdiff_t>(turns.size());
  };
  const auto n_change = [&] {
    std::uint64_t n = 0;
    for (const SharedMemory* shared : cluster.shared) n += shared->n_change();
    return n;
  };
  while (!stands(Stop::end)) {
    if (schedule.seed) std::shuffle(turns.begin(), turns.end(), cluster.random);
    const std::uint64_t before = n_change();
    bool goes_on = false, waits_for_phase = false;
    for (Block* block : turns) {
      if (block->stop == Stop::end || block->stop == Stop::cluster) continue;
      run_block(cluster, *block);
      (block->stop == Stop::mbarrier ? waits_for_phase : goes_on) = true;
    }
    if (stands(Stop::cluster))
      meet(cluster);
    else if (!goes_on && !waits_for_phase)
      throw Fault("some blocks end while others wait at a barrier of the cluster");
    else if (!goes_on && n_change() == before && !SharedMemory::bring_one(cluster.shared, cluster.random))
      throw Fault("waits for a phase of an mbarrier that never comes");
  }
}

}  // namespace

void run_ptx(const PtxKernel& kernel, Extent grid, unsigned n_thread, std::size_t n_shared, const void* job) {
  ++release_time;
  if (n_thread % kWarp != 0 || static_cast<int>(n_thread) > kernel.max_thread)
    throw Fault(kernel.name + ": " + std::to_string(n_thread) + " threads are not whole warps, or too many");
  static std::vector<Block> kept;  // whose memory was taken before
  if (kept.size() < grid.cluster) kept.resize(grid.cluster);
  const std::span blocks(kept.data(), grid.cluster);
  Cluster cluster = {kernel, grid, n_thread, blocks, {}, std::minstd_rand(schedule.seed), {}};
  for (Block& block : cluster.blocks) cluster.shared.push_back(&block.shared);
  BlockIndex& at = cluster.at;
  try {
    for (unsigned z = 0; z < grid.z; z += grid.cluster)
      for (unsigned y = 0; y < grid.y; ++y)
        for (unsigned x = 0; x < grid.x; ++x) {
          for (unsigned i = 0; i < grid.cluster; ++i)
            begin_block(cluster, cluster.blocks[i], {x, y, z + i}, n_shared, job);
          run_cluster(cluster);
        }
  } catch (const Fault& problem) {
    throw Fault(kernel.name + ", block " + std::to_string(at.x) + "," + std::to_string(at.y) + "," +
                std::to_string(at.z) + ": " + problem.what());
  }
}

}  // namespace vla::test::cuda
