// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <bit>
#include <cfenv>
#include <cmath>
#include <cstring>
#include <unordered_map>

#include "cuda/fault.h"
#include "cuda/fragments.h"
#include "cuda/ptx_warp.h"
#include "cuda/tensor_map.h"

namespace vla::test::cuda {

u64 release_time = 1;
namespace {

template <class F>
void each_lane(u32 active, F f) {
  if (active == kAll)
    for (int l = 0; l < kWarp; ++l) f(l);
  else
    for (; active != 0; active &= active - 1) f(std::countr_zero(active));
}

/// A result as a GPU leaves it: its NaN has bits of its own.
template <class To>
To result(To x) {
  if constexpr (std::is_same_v<To, float>)
    if (std::isnan(x)) return std::bit_cast<float>(0x7fffffff);
  return x;
}
/// An operation lane by lane; kF has no state.
template <auto kF, class To, class... From>
void lanes(WarpState& w, const PtxInstruction& i) {
  [&]<std::size_t... kI>(std::index_sequence<kI...>) {
    To* to = w.lanes<To>(i.operand[0]);
    [&](const auto*... from) {
      each_lane(w.active, [&](int l) { to[l] = result<To>(kF(from[l]...)); });
    }(w.lanes<From>(i.operand[kI + 1])...);
  }
  (std::index_sequence_for<From...>{});
}
template <auto kF, class T>
void compare(WarpState& w, const PtxInstruction& i) {
  const T *a = w.lanes<T>(i.operand[1]), *b = w.lanes<T>(i.operand[2]);
  u32 bits = 0;
  for (int l = 0; l < kWarp; ++l) bits |= static_cast<u32>(kF(a[l], b[l])) << l;
  u32& to = w.mask(i.operand[0]);
  to = (to & ~w.active) | (bits & w.active);
}
template <auto kF>
void masks(WarpState& w, const PtxInstruction& i) {
  u32& to = w.mask(i.operand[0]);
  const u32 a = w.mask(i.operand[1]), b = i.n_operand > 2 ? w.mask(i.operand[2]) : 0;
  to = (to & ~w.active) | (kF(a, b) & w.active);
}
template <class T>
void select(WarpState& w, const PtxInstruction& i) {
  const T *a = w.lanes<T>(i.operand[1]), *b = w.lanes<T>(i.operand[2]);
  T* to = w.lanes<T>(i.operand[0]);
  const u32 mask = w.mask(i.operand[3]);
  each_lane(w.active, [&](int l) { to[l] = mask >> l & 1 ? a[l] : b[l]; });
}

// Memory

[[noreturn]] void fault_at(const WarpState& w, const PtxInstruction& i, int lane, const char* what) {
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

// All lanes together

template <bool kTransposed>
void matrices(WarpState& w, const PtxInstruction& i) {
  std::size_t rows[kWarp];
  const u32* at = w.lanes<u32>(i.operand[4]);
  for (int l = 0; l < kWarp; ++l) rows[l] = static_cast<u32>(at[l] + static_cast<u32>(i.offset[0]));
  Lanes to[4];
  guarded(w, i, 0, [&] { load_matrices(to, rows, kTransposed, *w.shared, w.number); });
  for (int r = 0; r < 4; ++r) std::memcpy(w.lanes<u32>(i.operand[r]), to[r], sizeof(Lanes));
}
template <auto kMultiply>
void multiply(WarpState& w, const PtxInstruction& i) {
  Lanes in[10], to[4];  // a, b, sum
  for (int r = 0; r < 10; ++r) std::memcpy(in[r], w.lanes<u32>(i.operand[4 + r]), sizeof(Lanes));
  kMultiply(to, in, in + 4, in + 6);
  for (int r = 0; r < 4; ++r) std::memcpy(w.lanes<u32>(i.operand[r]), to[r], sizeof(Lanes));
}
/// Operands: to, a predicate that nobody reads, value, lane or mask, the bounds of a whole warp, membership of all.
template <bool kXor>
void shuffle(WarpState& w, const PtxInstruction& i) {
  const u32 *value = w.lanes<u32>(i.operand[2]), *which = w.lanes<u32>(i.operand[3]);
  u32 to[kWarp];
  for (int l = 0; l < kWarp; ++l) {
    if (w.lanes<u32>(i.operand[4])[l] != 31 || w.lanes<u32>(i.operand[5])[l] != kAll)
      fault_at(w, i, l, "a shuffle of a part of a warp");
    to[l] = value[kXor ? l ^ static_cast<int>(which[l] & 31) : static_cast<int>(which[l] & 31)];
  }
  std::memcpy(w.lanes<u32>(i.operand[0]), to, sizeof(to));
}
/// Takes registers of a product over, unless they are in flight already.
WgmmaRegisters* take(WarpState& w, const PtxInstruction& i, const std::vector<u32>& places) {
  const auto first = w.in_flight.find(places[0]);
  WgmmaRegisters* taken = first == w.in_flight.end() ? nullptr : first->second.first;
  if (taken == nullptr) taken = &w.wgmma_registers.emplace_back();
  taken->of.resize(places.size());
  for (std::size_t r = 0; r < places.size(); ++r) {
    const auto [at, is_new] = w.in_flight.try_emplace(places[r], taken, r);
    if (is_new && taken->n_product == 0) std::memcpy(&taken->of[r], w.lanes<u32>(places[r]), sizeof(Lanes));
    if (at->second != std::pair{taken, r} || (is_new && taken->n_product != 0))
      fault_at(w, i, 0, "registers of different products");
  }
  return taken;
}
void wgmma(WarpState& w, const PtxInstruction& i) {
  WgmmaProduct product = i.product;
  product.a = product.a_in_registers ? 0 : w.lanes<u64>(i.operand[0])[0];
  product.b = w.lanes<u64>(i.operand[1])[0];
  const u32 adds = w.mask(i.operand[2]);
  for (int l = 0; l < kWarp; ++l)
    if ((!product.a_in_registers && w.lanes<u64>(i.operand[0])[l] != product.a) ||
        w.lanes<u64>(i.operand[1])[l] != product.b)
      fault_at(w, i, l, "lanes of a warp issue different products");
  if (adds != 0 && adds != kAll) fault_at(w, i, 0, "lanes of a warp issue different products");
  product.adds = adds != 0;
  for (const u32 place : i.of_a)
    if (w.unfenced.contains(place)) fault_at(w, i, 0, "registers written without wgmma.fence after it");
  WgmmaRegisters* const a = product.a_in_registers ? take(w, i, i.of_a) : nullptr;
  WgmmaRegisters* const sums = take(w, i, i.sums);
  guarded(w, i, 0, [&] { w.wgmma.issue(product, *sums, a); });
}
void wgmma_wait(WarpState& w, const PtxInstruction& i) {
  guarded(w, i, 0, [&] { w.wgmma.wait(w.lanes<u32>(i.operand[0])[0]); });
  for (const auto& [place, taken] : w.in_flight)
    if (taken.first->n_product == 0) std::memcpy(w.lanes<u32>(place), &taken.first->of[taken.second], sizeof(Lanes));
  std::erase_if(w.in_flight, [](const auto& one) { return one.second.first->n_product == 0; });
  std::erase_if(w.wgmma_registers, [](const WgmmaRegisters& one) { return one.n_product == 0; });
}
void warp_barrier(WarpState& w, const PtxInstruction&) { w.shared->warp_barrier(w.number); }

float fma_down(float a, float b, float c) {
  const int before = std::fegetround();
  std::fesetround(FE_DOWNWARD);
  volatile float x = a, y = b, z = c;
  volatile float sum = std::fma(x, y, z);
  std::fesetround(before);
  return sum;
}
i32 to_int(float x) {  // to the nearest, ties to even; saturating, NaN to 0
  if (std::isnan(x)) return 0;
  return static_cast<i32>(std::clamp(std::nearbyint(static_cast<double>(x)), -2147483648.0, 2147483647.0));
}
float saturate(float x) { return std::isnan(x) ? 0 : std::fmin(std::fmax(x, 0.0f), 1.0f); }

/// Four bytes of a and b, each chosen by a digit, whose highest bit asks for the sign.
u32 permute(u32 a, u32 b, u32 digits) {
  const u64 both = static_cast<u64>(b) << 32 | a;
  u32 to = 0;
  for (int i = 0; i < 4; ++i) {
    const u32 digit = digits >> 4 * i & 15, byte = static_cast<u32>(both >> 8 * (digit & 7)) & 0xff;
    to |= (digit & 8 ? (byte & 0x80 ? 0xff : 0) : byte) << 8 * i;
  }
  return to;
}

#define ONE(To, A, ...) lanes<([](A a) -> To { return __VA_ARGS__; }), To, A>
#define TWO(To, T, ...) lanes<([](T a, T b) -> To { return __VA_ARGS__; }), To, T, T>
#define THREE(To, T, ...) lanes<([](T a, T b, T c) -> To { return __VA_ARGS__; }), To, T, T, T>
#define COMPARE(T, ...) compare<([](T a, T b) -> bool { return __VA_ARGS__; }), T>
#define COMPARISONS(type, operands, T)                                                                 \
  {"setp.eq." type, operands, COMPARE(T, a == b)}, {"setp.ne." type, operands, COMPARE(T, a != b)},    \
      {"setp.lt." type, operands, COMPARE(T, a < b)}, {"setp.le." type, operands, COMPARE(T, a <= b)}, \
      {"setp.gt." type, operands, COMPARE(T, a > b)}, {                                                \
    "setp.ge." type, operands, COMPARE(T, a >= b)                                                      \
  }

const PtxOperation kOperations[] = {
    {"add.s32", "ddd", TWO(u32, u32, a + b)},
    {"add.s64", "qqq", TWO(u64, u64, a + b)},
    {"sub.s32", "ddd", TWO(u32, u32, a - b)},
    {"sub.s64", "qqq", TWO(u64, u64, a - b)},
    {"mul.lo.s32", "ddd", TWO(u32, u32, a* b)},
    {"mul.lo.s64", "qqq", TWO(u64, u64, a* b)},
    {"mul.wide.s32", "qdd", TWO(i64, i32, static_cast<i64>(a) * b)},
    {"mul.wide.u32", "qdd", TWO(u64, u32, static_cast<u64>(a) * b)},
    {"mul.hi.s32", "ddd", TWO(u32, i32, static_cast<u32>(static_cast<u64>(static_cast<i64>(a) * b) >> 32))},
    {"mul.hi.u32", "ddd", TWO(u32, u32, static_cast<u32>(static_cast<u64>(a) * b >> 32))},
    {"mad.lo.s32", "dddd", THREE(u32, u32, a* b + c)},
    {"mad.lo.s64", "qqqq", THREE(u64, u64, a* b + c)},
    {"mad.wide.s32", "qddq",
     lanes<([](i32 a, i32 b, i64 c) -> i64 { return static_cast<i64>(a) * b + c; }), i64, i32, i32, i64>},
    {"mad.wide.u32", "qddq",
     lanes<([](u32 a, u32 b, u64 c) -> u64 { return static_cast<u64>(a) * b + c; }), u64, u32, u32, u64>},
    {"div.s32", "ddd", TWO(i32, i32, b == 0 ? -1 : static_cast<i32>(static_cast<i64>(a) / b))},
    {"div.u32", "ddd", TWO(u32, u32, b == 0 ? ~u32{0} : a / b)},
    {"div.s64", "qqq", TWO(i64, i64, b == 0 ? -1 : a / b)},
    {"div.u64", "qqq", TWO(u64, u64, b == 0 ? ~u64{0} : a / b)},
    {"rem.s32", "ddd", TWO(i32, i32, b == 0 ? a : static_cast<i32>(static_cast<i64>(a) % b))},
    {"rem.u32", "ddd", TWO(u32, u32, b == 0 ? a : a % b)},
    {"rem.s64", "qqq", TWO(i64, i64, b == 0 ? a : a % b)},
    {"rem.u64", "qqq", TWO(u64, u64, b == 0 ? a : a % b)},
    {"min.s32", "ddd", TWO(i32, i32, std::min(a, b))},
    {"max.s32", "ddd", TWO(i32, i32, std::max(a, b))},
    {"min.u32", "ddd", TWO(u32, u32, std::min(a, b))},
    {"max.u32", "ddd", TWO(u32, u32, std::max(a, b))},
    {"neg.s32", "dd", ONE(u32, u32, 0 - a)},
    {"abs.s32", "dd", ONE(i32, i32, a < 0 ? -a : a)},
    {"and.b32", "ddd", TWO(u32, u32, a& b)},
    {"or.b32", "ddd", TWO(u32, u32, a | b)},
    {"xor.b32", "ddd", TWO(u32, u32, a ^ b)},
    {"not.b32", "dd", ONE(u32, u32, ~a)},
    {"and.b64", "qqq", TWO(u64, u64, a& b)},
    {"or.b64", "qqq", TWO(u64, u64, a | b)},
    {"and.b16", "ddd", TWO(u32, u32, a& b)},
    {"or.b16", "ddd", TWO(u32, u32, a | b)},
    {"shl.b32", "ddd", TWO(u32, u32, b > 31 ? 0 : a << b)},
    {"shr.u32", "ddd", TWO(u32, u32, b > 31 ? 0 : a >> b)},
    {"shr.s32", "ddd", lanes<([](i32 a, u32 b) -> i32 { return a >> std::min(b, 31U); }), i32, i32, u32>},
    {"shl.b64", "qqd", lanes<([](u64 a, u32 b) -> u64 { return b > 63 ? 0 : a << b; }), u64, u64, u32>},
    {"shr.u64", "qqd", lanes<([](u64 a, u32 b) -> u64 { return b > 63 ? 0 : a >> b; }), u64, u64, u32>},
    {"shr.s64", "qqd", lanes<([](i64 a, u32 b) -> i64 { return a >> std::min(b, 63U); }), i64, i64, u32>},
    {"shl.b16", "ddd", TWO(u32, u32, b > 15 ? 0 : a << b & 0xffff)},
    {"mov.u32", "dd", ONE(u32, u32, a)},
    {"mov.b32", "dd", ONE(u32, u32, a)},
    {"mov.f32", "dd", ONE(u32, u32, a)},
    {"mov.u16", "dd", ONE(u32, u32, a)},
    {"mov.b16", "dd", ONE(u32, u32, a)},
    {"mov.u64", "qq", ONE(u64, u64, a)},
    {"mov.b64", "qq", ONE(u64, u64, a)},
    {"cvta.to.global.u64", "qq", ONE(u64, u64, a)},
    {"selp.b32", "dddp", select<u32>},
    {"selp.u32", "dddp", select<u32>},
    {"selp.s32", "dddp", select<u32>},
    {"selp.f32", "dddp", select<u32>},
    {"selp.b16", "dddp", select<u32>},
    {"selp.u16", "dddp", select<u32>},
    {"selp.b64", "qqqp", select<u64>},
    {"and.pred", "ppp", masks<([](u32 a, u32 b) { return a & b; })>},
    {"or.pred", "ppp", masks<([](u32 a, u32 b) { return a | b; })>},
    {"xor.pred", "ppp", masks<([](u32 a, u32 b) { return a ^ b; })>},
    {"not.pred", "pp", masks<([](u32 a, u32) { return ~a; })>},
    {"mov.pred", "pp", masks<([](u32 a, u32) { return a; })>},
    COMPARISONS("s32", "pdd", i32),
    COMPARISONS("u32", "pdd", u32),
    COMPARISONS("f32", "pdd", float),
    COMPARISONS("s64", "pqq", i64),
    COMPARISONS("u64", "pqq", u64),
    {"setp.ltu.f32", "pdd", COMPARE(float, !(a >= b))},
    {"setp.leu.f32", "pdd", COMPARE(float, !(a > b))},
    {"setp.gtu.f32", "pdd", COMPARE(float, !(a <= b))},
    {"setp.geu.f32", "pdd", COMPARE(float, !(a < b))},
    {"setp.neu.f32", "pdd", COMPARE(float, !(a == b))},
    {"setp.nan.f32", "pdd", COMPARE(float, std::isnan(a) || std::isnan(b))},
    {"setp.eq.s16", "pdd", COMPARE(u32, (a & 0xffff) == (b & 0xffff))},
    {"setp.ne.s16", "pdd", COMPARE(u32, (a & 0xffff) != (b & 0xffff))},
    {"setp.eq.b64", "pqq", COMPARE(u64, a == b)},
    {"setp.eq.b32", "pdd", COMPARE(u32, a == b)},
    {"setp.ne.b32", "pdd", COMPARE(u32, a != b)},
    {"cvt.s64.s32", "qd", ONE(i64, i32, a)},
    {"cvt.s64.s32 of 64 bits", "qq", ONE(i64, i64, static_cast<i32>(a))},
    {"cvt.u64.u32", "qd", ONE(u64, u32, a)},
    {"cvt.u32.u64", "dq", ONE(u32, u64, static_cast<u32>(a))},
    {"cvt.u32.u16", "dd", ONE(u32, u32, a & 0xffff)},
    {"cvt.u16.u32", "dd", ONE(u32, u32, a & 0xffff)},
    {"cvt.s16.s8", "dd", ONE(u32, u32, static_cast<u32>(static_cast<std::int8_t>(a)) & 0xffff)},
    {"cvt.s32.s8", "dd", ONE(i32, u32, static_cast<std::int8_t>(a))},
    {"cvt.rn.f32.s32", "dd", ONE(float, i32, static_cast<float>(a))},
    {"cvt.rn.f32.u32", "dd", ONE(float, u32, static_cast<float>(a))},
    {"cvt.rni.s32.f32", "dd", ONE(i32, float, to_int(a))},
    {"cvt.rzi.s32.f32", "dd", ONE(i32, float, to_int(std::trunc(a)))},
    {"cvt.rmi.f32.f32", "dd", ONE(float, float, std::floor(a))},
    {"cvt.sat.f32.f32", "dd", ONE(float, float, saturate(a))},
    {"cvt.rn.bf16x2.f32", "ddd", TWO(u32, float, float_to_bf16(b) | float_to_bf16(a) << 16)},
    {"cvt.f32.f16", "dd", ONE(float, u32, f16_to_float(a & 0xffff))},
    {"prmt.b32", "dddd", THREE(u32, u32, permute(a, b, c))},
    {"add.f32", "ddd", TWO(float, float, a + b)},
    {"add.rn.f32", "ddd", TWO(float, float, a + b)},
    {"sub.f32", "ddd", TWO(float, float, a - b)},
    {"mul.f32", "ddd", TWO(float, float, a* b)},
    {"mul.rn.f32", "ddd", TWO(float, float, a* b)},
    {"div.rn.f32", "ddd", TWO(float, float, a / b)},
    {"fma.rn.f32", "dddd", THREE(float, float, __builtin_fmaf(a, b, c))},
    {"fma.rm.f32", "dddd", THREE(float, float, fma_down(a, b, c))},
    {"neg.f32", "dd", ONE(float, float, -a)},
    {"abs.f32", "dd", ONE(float, float, std::fabs(a))},
    {"min.f32", "ddd", TWO(float, float, std::fmin(a, b))},
    {"max.f32", "ddd", TWO(float, float, std::fmax(a, b))},
    {"copysign.f32", "ddd", TWO(float, float, std::copysign(b, a))},
    {"sqrt.rn.f32", "dd", ONE(float, float, std::sqrt(a))},
    {"rcp.rn.f32", "dd", ONE(float, float, 1 / a)},
    // Approximations: a GPU's differ from these in the last bits.
    {"rcp.approx.ftz.f32", "dd", ONE(float, float, 1 / a)},
    {"ex2.approx.ftz.f32", "dd", ONE(float, float, exp2f(a))},
    {"setp.num.f32", "pdd", COMPARE(float, !std::isnan(a) && !std::isnan(b))},
    {"setp.nan.f32", "pdd", COMPARE(float, std::isnan(a) || std::isnan(b))},
    {"ex2.approx.f32", "dd", ONE(float, float, exp2f(a))},
    {"dp4a.s32.s32", "dddd", THREE(u32, u32, static_cast<u32>(vla::cuda::dev::dot4(a, b, static_cast<int>(c))))},
    {"cp.async.cg.shared.global", "sgdd", copy_async},
    {"cp.async.commit_group", "",
     [](WarpState& w, const PtxInstruction&) { each_lane(w.active, [&](int l) { w.shared->commit(w.thread(l)); }); }},
    {"cp.async.wait_group", "d",
     [](WarpState& w,
        const PtxInstruction&
            i) { each_lane(w.active, [&](int l) { w.shared->wait(w.lanes<u32>(i.operand[0])[l], w.thread(l)); }); }},
    {"fence.proxy.async.shared::cta", "",
     [](WarpState& w,
        const PtxInstruction&) { each_lane(w.active, [&](int l) { w.shared->fence_async(w.thread(l)); }); }},
    {"mbarrier.init.shared::cta.b64", "sd", begin_mbarrier},
    {"fence.mbarrier_init.release.cluster", "",
     [](WarpState& w,
        const PtxInstruction&) { each_lane(w.active, [&](int l) { w.shared->fence_mbarriers(w.thread(l)); }); }},
    {"mbarrier.arrive.shared::cta.b64", "_s", arrive<false>},
    {"mbarrier.arrive.expect_tx.shared::cta.b64", "_sd", arrive<true>},
    {"mbarrier.arrive.shared::cluster.b64", "_s", arrive_at_block},
    {"mbarrier.try_wait.parity.shared::cta.b64", "psd", try_wait},
    {"cvta.param.u64", "qq", address_of_param},
    {"wgmma.fence.sync.aligned", "", [](WarpState& w, const PtxInstruction&) { w.wgmma.fence(), w.unfenced.clear(); },
     PtxInstruction::kWarp},
    {"wgmma.commit_group.sync.aligned", "", [](WarpState& w, const PtxInstruction&) { w.wgmma.commit(); },
     PtxInstruction::kWarp},
    {"wgmma.wait_group.sync.aligned", "d", wgmma_wait, PtxInstruction::kWarp},
    {"griddepcontrol.launch_dependents", "", [](WarpState&, const PtxInstruction&) {}},
    {"griddepcontrol.wait", "", [](WarpState& w, const PtxInstruction&) { w.early &= ~w.active; }},
    {"bar.sync", "d", nullptr, PtxInstruction::kBarrier},
    {"bar.warp.sync", "d", warp_barrier, PtxInstruction::kWarp},
    {"barrier.cluster.arrive.release.aligned", "",
     [](WarpState& w, const PtxInstruction&) { w.arrival = WarpState::kReleased; }, PtxInstruction::kWarp},
    {"barrier.cluster.arrive.relaxed.aligned", "",
     [](WarpState& w, const PtxInstruction&) { w.arrival = WarpState::kRelaxed; }, PtxInstruction::kWarp},
    {"barrier.cluster.wait.acquire.aligned", "", nullptr, PtxInstruction::kCluster},
    {"mapa.shared::cluster.u32", "ddd", map_to_block},
    {"shfl.sync.bfly.b32", "dpdddd", shuffle<true>, PtxInstruction::kWarp},
    {"shfl.sync.idx.b32", "dpdddd", shuffle<false>, PtxInstruction::kWarp},
    {"ldmatrix.sync.aligned.m8n8.x4.shared.b16", "dddds", matrices<false>, PtxInstruction::kWarp},
    {"ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16", "dddds", matrices<true>, PtxInstruction::kWarp},
    {"mma.sync.aligned.m16n8k32.row.col.s32.s8.s8.s32", "dddddddddddddd", multiply<mma_s8>, PtxInstruction::kWarp},
    {"mma.sync.aligned.m16n8k16.row.col.f32.bf16.bf16.f32", "dddddddddddddd", multiply<mma_bf16>,
     PtxInstruction::kWarp},
};
}  // namespace

bool renames(WarpState& w, const PtxInstruction& i) {
  const auto found = i.is_move ? w.in_flight.find(i.operand[1]) : w.in_flight.end();
  if (i.is_move) w.in_flight.erase(i.operand[0]);
  if (found != w.in_flight.end()) {
    if (w.active != kAll) fault_at(w, i, 0, "touches registers of wgmma that it has not waited for");
    const auto sum = found->second;
    w.in_flight[i.operand[0]] = sum;
    return true;
  }
  for (int k = 0; k < i.n_operand; ++k)
    if (w.in_flight.contains(i.operand[k])) fault_at(w, i, 0, "touches registers of wgmma that it has not waited for");
  return false;
}

const PtxOperation* find_operation(const std::string& name) {
  static const std::unordered_map<std::string, PtxOperation> all = [] {
    std::unordered_map<std::string, PtxOperation> table;
    for (const PtxOperation& one : kOperations) table.emplace(one.name, one);
    return table;
  }();
  const auto found = all.find(name);
  return found == all.end() ? nullptr : &found->second;
}

void (*find_wgmma(const std::string& name, WgmmaProduct& product))(WarpState&, const PtxInstruction&) {
  const std::string_view start = "wgmma.mma_async.sync.aligned.m64n";
  if (name.compare(0, start.size(), start) != 0) return nullptr;
  char* end = nullptr;
  product.n = static_cast<int>(std::strtol(name.c_str() + start.size(), &end, 10));
  const std::string_view shape = end;
  if (product.n < 8 || product.n > 256 || product.n % 8 != 0) return nullptr;
  if (shape != "k16.f32.bf16.bf16" && shape != "k32.s32.s8.s8") return nullptr;
  product.kind = shape[1] == '1' ? WgmmaProduct::bf16 : WgmmaProduct::s8;
  return wgmma;
}

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
