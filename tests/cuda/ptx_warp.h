// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <bit>
#include <list>
#include <map>
#include <set>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "cuda/fault.h"
#include "cuda/ptx.h"
#include "cuda/wgmma.h"

/// What instructions change (ptx_instructions.cpp, ptx_memory.cpp, ptx_wgmma.cpp), and who runs them reads
/// (ptx_run.cpp).
namespace vla::test::cuda {

using u32 = std::uint32_t;
using u64 = std::uint64_t;
using i32 = std::int32_t;
using i64 = std::int64_t;
constexpr u32 kAll = ~u32{0};

/// Grows with every launch: where an access went before may have been released.
extern u64 release_time;

/// A warp: its registers, and how far each lane is.
struct WarpState {
  std::vector<std::byte> registers;
  u32 active = 0;        // lanes that do the instruction
  u32 live = kAll;       // lanes that have not returned
  u32 waits = 0;         // lanes at an instruction that all lanes do together
  u32 early = 0;         // lanes that have not waited for earlier kernels yet
  bool together = true;  // all lanes that live are at pc
  int pc = 0, pcs[kWarp] = {};
  int number = 0;
  long n_done = 0;
  const std::byte* job = nullptr;
  std::size_t job_size = 0;
  SharedMemory* shared = nullptr;
  std::span<SharedMemory* const> cluster;               // shared memory of its blocks
  enum { kAway, kRelaxed, kReleased } arrival = kAway;  // at a barrier of the cluster
  enum class Stop { none, end, barrier, cluster, mbarrier } stop = Stop::none;
  bool waits_for_phase = false;  // a phase of an mbarrier has not ended yet
  Wgmma wgmma;
  std::list<WgmmaRegisters> wgmma_registers;                         // in flight
  std::map<u32, std::pair<WgmmaRegisters*, std::size_t>> in_flight;  // registers of such
  std::set<u32> unfenced;  // registers of operand a that were written since the last wgmma.fence

  template <class T>
  T* lanes(u32 place) {
    return reinterpret_cast<T*>(&registers[place]);
  }
  u32& mask(u32 place) { return *lanes<u32>(place); }
  int thread(int lane) const { return number * kWarp + lane; }
};

template <class F>
void each_lane(u32 active, F f) {
  if (active == kAll)
    for (int l = 0; l < kWarp; ++l) f(l);
  else
    for (; active != 0; active &= active - 1) f(std::countr_zero(active));
}
[[noreturn]] inline void fault_at(const WarpState& w, const PtxInstruction& i, int lane, const char* what) {
  throw Fault("thread " + std::to_string(w.thread(lane)) + ": " + what + ": " + i.text);
}
template <class F>
void guarded(const WarpState& w, const PtxInstruction& i, const int& lane, F access) {
  try {
    access();
  } catch (const Fault& problem) {
    fault_at(w, i, lane, problem.what());
  }
}

/// While products are in flight, other instructions than wgmma may only rename their registers. Whether that was done.
bool renames(WarpState& w, const PtxInstruction& i);

}  // namespace vla::test::cuda
