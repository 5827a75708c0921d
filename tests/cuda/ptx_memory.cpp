// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cstring>

#include "cuda/ptx_warp.h"
#include "cuda/tensor_map.h"

namespace vla::test::cuda {

u64 release_time = 1;
namespace {

DeviceMemory::Allocation* fresh_hint(const PtxInstruction& i) {
  if (i.hint_time != release_time) i.hint = nullptr, i.hint_time = release_time;
  return i.hint;
}

std::byte* global(WarpState& w, const PtxInstruction& i, int which, int lane, std::size_t size, bool writes) {
  const u64 p = w.lanes<u64>(i.operand[which])[lane] + static_cast<u64>(i.offset[which]);
  guarded(w, i, lane, [&] { i.hint = device_memory().check(p, size, writes, fresh_hint(i)); });
  if (w.early >> lane & 1 && (writes || device_memory().has_result(*i.hint, p, size)))
    fault_at(w, i, lane, "does not wait for earlier kernels");
  return reinterpret_cast<std::byte*>(p);
}
/// An address in shared memory that is an operand, the first if none is named.
std::size_t in_shared(WarpState& w, const PtxInstruction& i, int lane, int which = 0) {
  return static_cast<u32>(w.lanes<u32>(i.operand[which])[lane] + static_cast<u32>(i.offset[0]));
}

void load_value(WarpState& w, const PtxInstruction& i, int lane, const std::byte* from) {
  if (i.width == 4 && !i.wide_value) {  // by far the most
    for (int k = 0; k < i.count; ++k) std::memcpy(&w.lanes<u32>(i.operand[k + 1])[lane], from + 4 * k, 4);
    return;
  }
  for (int k = 0; k < i.count; ++k, from += i.width) {
    u64 value = 0;
    std::memcpy(&value, from, static_cast<std::size_t>(i.width));
    const int unused = 64 - 8 * i.width;
    if (i.sign) value = static_cast<u64>(static_cast<i64>(value << unused) >> unused);
    const u32 place = i.operand[k + 1];
    i.wide_value ? void(w.lanes<u64>(place)[lane] = value) : void(w.lanes<u32>(place)[lane] = static_cast<u32>(value));
  }
}
void store_value(WarpState& w, const PtxInstruction& i, int lane, std::byte* to) {
  if (i.width == 4 && !i.wide_value) {
    for (int k = 0; k < i.count; ++k) std::memcpy(to + 4 * k, &w.lanes<u32>(i.operand[k + 1])[lane], 4);
    return;
  }
  for (int k = 0; k < i.count; ++k, to += i.width) {
    const u32 place = i.operand[k + 1];
    const void* from = i.wide_value ? static_cast<void*>(&w.lanes<u64>(place)[lane]) : &w.lanes<u32>(place)[lane];
    std::memcpy(to, from, static_cast<std::size_t>(i.width));
  }
}
std::size_t access_size(const PtxInstruction& i) { return static_cast<std::size_t>(i.width * i.count); }

void load_param(WarpState& w, const PtxInstruction& i) {
  each_lane(w.active, [&](int l) {
    const u64 base = i.wide_address ? w.lanes<u64>(i.operand[0])[l] : w.lanes<u32>(i.operand[0])[l];
    const u64 at = base + static_cast<u64>(i.offset[0]);
    if (at + access_size(i) > w.job_size) fault_at(w, i, l, "reads behind the parameter");
    load_value(w, i, l, w.job + at);
  });
}
void load_global(WarpState& w, const PtxInstruction& i) {
  each_lane(w.active, [&](int l) { load_value(w, i, l, global(w, i, 0, l, access_size(i), false)); });
}
void store_global(WarpState& w, const PtxInstruction& i) {
  each_lane(w.active, [&](int l) { store_value(w, i, l, global(w, i, 0, l, access_size(i), true)); });
}
template <bool kWrites>
void access_shared(WarpState& w, const PtxInstruction& i) {
  std::size_t offsets[kWarp];
  std::fill(offsets, offsets + kWarp, SharedMemory::kNone);
  const std::size_t size = access_size(i);
  int lane = 0;
  guarded(w, i, lane, [&] {
    each_lane(w.active, [&](int l) {
      lane = l;
      const std::size_t at = offsets[l] = in_shared(w, i, l);
      kWrites ? w.shared->write(at, size, w.thread(l)) : w.shared->read(at, size, w.thread(l));
      kWrites ? store_value(w, i, l, w.shared->data() + at) : load_value(w, i, l, w.shared->data() + at);
    });
  });
  SharedMemory::count_conflicts(offsets, size);
}
/// An address in a cluster's shared memory: a block's rank, plus 1, above what is an address in a block's own.
constexpr int kRankAt = 24;
void map_to_block(WarpState& w, const PtxInstruction& i) {
  const u32 *address = w.lanes<u32>(i.operand[1]), *rank = w.lanes<u32>(i.operand[2]);
  each_lane(w.active, [&](int l) {
    if (rank[l] >= w.cluster.size()) fault_at(w, i, l, "the cluster has no such block");
    if (address[l] >> kRankAt != 0) fault_at(w, i, l, "address is not in shared memory");
    w.lanes<u32>(i.operand[0])[l] = (rank[l] + 1) << kRankAt | address[l];
  });
}
SharedMemory& block_of(const WarpState& w, const PtxInstruction& i, int lane, std::size_t address) {
  const std::size_t block = address >> kRankAt;
  if (block == 0 || block > w.cluster.size()) fault_at(w, i, lane, "address that mapa has not made");
  return *w.cluster[block - 1];
}
std::size_t within_block(std::size_t address) { return address & ((std::size_t{1} << kRankAt) - 1); }
void load_of_cluster(WarpState& w, const PtxInstruction& i) {
  std::size_t offsets[kWarp];
  std::fill(offsets, offsets + kWarp, SharedMemory::kNone);
  const std::size_t size = access_size(i);
  each_lane(w.active, [&](int l) {
    const std::size_t address = in_shared(w, i, l);
    SharedMemory& of = block_of(w, i, l, address);
    const std::size_t at = offsets[l] = within_block(address);
    guarded(w, i, l, [&] { &of == w.shared ? of.read(at, size, w.thread(l)) : of.read_by_other(at, size); });
    load_value(w, i, l, of.data() + at);
  });
  SharedMemory::count_conflicts(offsets, size);
}
void copy_async(WarpState& w, const PtxInstruction& i) {
  const u32* bytes = w.lanes<u32>(i.operand[2]);
  const u32* sizes = w.lanes<u32>(i.operand[3]);
  each_lane(w.active, [&](int l) {
    if (bytes[l] != 16) fault_at(w, i, l, "an asynchronous copy that is not of 16 bytes");
    const std::byte* from = nullptr;
    if (sizes[l] != 0) {  // what is read must be there, and its address aligned to all 16
      from = reinterpret_cast<std::byte*>(w.lanes<u64>(i.operand[1])[l] + static_cast<u64>(i.offset[1]));
      const auto at = reinterpret_cast<std::uintptr_t>(from);
      if (at % 16 != 0) fault_at(w, i, l, "source of an asynchronous copy is not aligned");
      for (u32 b = 0, step = sizes[l] == 16 ? 16 : 1; b < sizes[l]; b += step)
        guarded(w, i, l, [&] { i.hint = device_memory().check(at + b, step, false, fresh_hint(i)); });
      if (w.early >> l & 1 && device_memory().has_result(*i.hint, at, sizes[l]))
        fault_at(w, i, l, "does not wait for earlier kernels");
    }
    guarded(w, i, l, [&] { w.shared->copy(in_shared(w, i, l), from, sizes[l], w.thread(l)); });
  });
}

// mbarriers, and copies that they count

void begin_mbarrier(WarpState& w, const PtxInstruction& i) {
  each_lane(w.active, [&](int l) {
    const auto n_arrival = w.lanes<i32>(i.operand[1])[l];
    guarded(w, i, l, [&] { w.shared->begin_mbarrier(in_shared(w, i, l), n_arrival, w.thread(l)); });
  });
}
template <bool kExpects>
void arrive(WarpState& w, const PtxInstruction& i) {
  each_lane(w.active, [&](int l) {
    const u32 n_byte = kExpects ? w.lanes<u32>(i.operand[1])[l] : 0;
    guarded(w, i, l, [&] { w.shared->arrive(in_shared(w, i, l), n_byte, *w.shared, w.thread(l)); });
  });
}
void arrive_at_block(WarpState& w, const PtxInstruction& i) {
  each_lane(w.active, [&](int l) {
    const std::size_t address = in_shared(w, i, l);
    SharedMemory& of = block_of(w, i, l, address);
    guarded(w, i, l, [&] { of.arrive(within_block(address), 0, *w.shared, w.thread(l)); });
  });
}
/// A warp that waits lets others go on before it looks again.
void try_wait(WarpState& w, const PtxInstruction& i) {
  u32 ended = 0;
  each_lane(w.active, [&](int l) {
    const u32 parity = w.lanes<u32>(i.operand[2])[l];
    guarded(w, i, l, [&] {
      if (parity > 1) throw Fault("a parity that is neither 0 nor 1");
      ended |= static_cast<u32>(w.shared->try_wait(in_shared(w, i, l, 1), parity, w.thread(l))) << l;
    });
  });
  u32& to = w.mask(i.operand[0]);
  to = (to & ~w.active) | ended;
  w.waits_for_phase = ended != w.active;
}
/// The address of a parameter as one that any instruction takes: the host's.
void address_of_param(WarpState& w, const PtxInstruction& i) {
  each_lane(w.active, [&](int l) {
    w.lanes<u64>(i.operand[0])[l] = reinterpret_cast<u64>(w.job) + w.lanes<u64>(i.operand[1])[l];
  });
}
template <bool kHasMask>
void run_box_copy(WarpState& w, const PtxInstruction& i) {
  const auto copy = [&](int l) {
    const u64 map = w.lanes<u64>(i.operand[1])[l] - reinterpret_cast<u64>(w.job);
    if (map + sizeof(vla::cuda::TensorMap) > w.job_size) throw Fault("a tensor map that is not in the parameter");
    if (map % alignof(vla::cuda::TensorMap) != 0) throw Fault("a tensor map that is not aligned");
    const int n = i.count;  // dimensions
    const std::size_t to = w.lanes<u32>(i.operand[0])[l], mbarrier = w.lanes<u32>(i.operand[2 + n])[l];
    i32 place[4];
    for (int d = 0; d < n; ++d) place[d] = w.lanes<i32>(i.operand[2 + d])[l];
    const auto read = [&](std::uintptr_t from, std::size_t size) {
      i.hint = device_memory().check(from, size, false, fresh_hint(i));
      if (w.early >> l & 1 && device_memory().has_result(*i.hint, from, size))
        throw Fault("does not wait for earlier kernels");
      return reinterpret_cast<const std::byte*>(from);
    };
    const std::vector<std::byte> box = copy_box(w.job + map, std::span(place, static_cast<std::size_t>(n)), to, read);
    if (!kHasMask) return w.shared->bulk_copy(to, box, mbarrier, *w.shared, w.thread(l));
    const u32 blocks = w.lanes<u32>(i.operand[3 + n])[l] & 0xffff;
    for (std::size_t rank = 0; blocks >> rank != 0; ++rank) {
      if ((blocks >> rank & 1) == 0) continue;
      if (rank >= w.cluster.size()) throw Fault("the cluster has no such block");
      w.cluster[rank]->bulk_copy(to, box, mbarrier, *w.shared, w.thread(l));
    }
  };
  each_lane(w.active, [&](int l) { guarded(w, i, l, [&] { copy(l); }); });
}
const PtxOperation kOperations[] = {
    {"cp.async.cg.shared.global", "sgdd", copy_async},
    {"cp.async.commit_group", "",
     [](WarpState& w, const PtxInstruction&) { each_lane(w.active, [&](int l) { w.shared->commit(w.thread(l)); }); }},
    {"cp.async.wait_group", "d",
     [](WarpState& w, const PtxInstruction& i) {
       each_lane(w.active, [&](int l) { w.shared->wait(w.lanes<u32>(i.operand[0])[l], w.thread(l)); });
     }},
    {"fence.proxy.async.shared::cta", "",
     [](WarpState& w, const PtxInstruction&) {
       each_lane(w.active, [&](int l) { w.shared->fence_async(w.thread(l)); });
     }},
    {"mbarrier.init.shared::cta.b64", "sd", begin_mbarrier},
    {"fence.mbarrier_init.release.cluster", "",
     [](WarpState& w, const PtxInstruction&) {
       each_lane(w.active, [&](int l) { w.shared->fence_mbarriers(w.thread(l)); });
     }},
    {"mbarrier.arrive.shared::cta.b64", "_s", arrive<false>},
    {"mbarrier.arrive.expect_tx.shared::cta.b64", "_sd", arrive<true>},
    {"mbarrier.arrive.shared::cluster.b64", "_s", arrive_at_block},
    {"mbarrier.try_wait.parity.shared::cta.b64", "psd", try_wait},
    {"cvta.param.u64", "qq", address_of_param},
    {"mapa.shared::cluster.u32", "ddd", map_to_block},
};
}  // namespace

std::span<const PtxOperation> memory_operations() { return kOperations; }

void (*find_box_copy(const std::string& name, int& n_dimension, bool& has_mask))(WarpState&, const PtxInstruction&) {
  const std::string start = "cp.async.bulk.tensor.", end = "d.shared::cluster.global.mbarrier::complete_tx::bytes";
  for (const int n : {2, 4})
    for (const bool is_for_others : {false, true}) {
      if (name != start + std::to_string(n) + end + (is_for_others ? ".multicast::cluster" : "")) continue;
      n_dimension = n, has_mask = is_for_others;
      return is_for_others ? run_box_copy<true> : run_box_copy<false>;
    }
  return nullptr;
}

void (*find_access(const std::string& operation, const std::string& space))(WarpState&, const PtxInstruction&) {
  const bool loads = operation == "ld";
  if (space == "param" && loads) return load_param;
  if (space == "shared::cluster" && loads) return load_of_cluster;
  if (space == "global") return loads ? load_global : store_global;
  if (space == "shared") return loads ? access_shared<false> : access_shared<true>;
  return nullptr;
}
}  // namespace vla::test::cuda
