// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <bit>
#include <random>

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

/// Runs a warp until it ends (true) or stands at a barrier of the block.
bool run_warp(WarpState& w, const PtxKernel& kernel) {
  while (w.live != 0) {
    const u32 group = w.together ? w.live : next_group(w);
    const PtxInstruction& i = kernel.code.at(static_cast<std::size_t>(w.pc));
    u32 active = group;
    if (i.has_guard) active &= i.guard_is_not ? ~w.mask(i.guard) : w.mask(i.guard);
    ++counts.instructions;
    if (++w.n_done > kForever) throw Fault("a warp does not come to an end");
    int next = w.pc + 1;
    u32 jumps = 0;
    switch (i.kind) {
      case PtxInstruction::kPlain:
        w.active = active;
        if (active != 0 && (w.in_flight.empty() || !renames(w, i))) i.run(w, i);
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
          return false;
        }
    }
    const u32 stay = group & ~jumps & w.live;
    if (w.together && (jumps == 0 || stay == 0)) {
      w.pc = jumps != 0 ? i.target : next;
      continue;
    }
    if (w.together) w.together = false;
    for (int l = 0; l < kWarp; ++l)
      if (group >> l & 1) w.pcs[l] = jumps >> l & 1 ? i.target : next;
  }
  return true;
}

struct BlockIndex {
  unsigned x, y, z;
};

void run_block(const PtxKernel& kernel, Extent grid, BlockIndex at, unsigned n_thread, std::size_t n_shared,
               const void* job, SharedMemory& shared, std::vector<WarpState>& warps, std::minstd_rand& random) {
  const std::size_t dynamic = (kernel.static_shared + 1023) / 1024 * 1024;
  shared.begin(dynamic + n_shared, static_cast<int>(n_thread));
  device_memory().begin_block();
  for (std::size_t i = 0; i < warps.size(); ++i) {
    WarpState& w = warps[i];
    w.live = kAll, w.waits = 0, w.early = kernel.overlaps ? kAll : 0, w.together = true, w.pc = 0, w.n_done = 0;
    w.number = static_cast<int>(i), w.job = static_cast<const std::byte*>(job), w.job_size = kernel.param_size;
    w.shared = &shared;
    w.wgmma.begin(shared, w.number), w.in_flight.clear(), w.sums.clear();
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
  std::vector<WarpState*> order;
  for (WarpState& w : warps) order.push_back(&w);
  while (true) {
    if (schedule.seed) std::shuffle(order.begin(), order.end(), random);
    std::size_t n_end = 0;
    for (WarpState* w : order) n_end += run_warp(*w, kernel);
    if (n_end == order.size()) break;
    if (n_end != 0) throw Fault("some threads end while others wait at a barrier");
    shared.barrier();
    ++counts.barriers;
  }
  std::vector<const Wgmma*> products;
  for (const WarpState& w : warps) products.push_back(&w.wgmma);
  check_warpgroups(products);
}

}  // namespace

void run_ptx(const PtxKernel& kernel, Extent grid, unsigned n_thread, std::size_t n_shared, const void* job) {
  ++release_time;
  if (n_thread % kWarp != 0 || static_cast<int>(n_thread) > kernel.max_thread)
    throw Fault(kernel.name + ": " + std::to_string(n_thread) + " threads are not whole warps, or too many");
  SharedMemory shared;
  std::vector<WarpState> warps(n_thread / kWarp);
  std::minstd_rand random(schedule.seed);
  BlockIndex at = {};
  try {
    for (at.z = 0; at.z < grid.z; ++at.z)
      for (at.y = 0; at.y < grid.y; ++at.y)
        for (at.x = 0; at.x < grid.x; ++at.x)
          run_block(kernel, grid, at, n_thread, n_shared, job, shared, warps, random);
  } catch (const Fault& problem) {
    throw Fault(kernel.name + ", block " + std::to_string(at.x) + "," + std::to_string(at.y) + "," +
                std::to_string(at.z) + ": " + problem.what());
  }
}

}  // namespace vla::test::cuda
