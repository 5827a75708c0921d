// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <bit>
#include <cfenv>
#include <cmath>
#include <cstring>
#include <unordered_map>

#include "cuda/fragments.h"
#include "cuda/ptx_warp.h"

namespace vla::test::cuda {

namespace {

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
    {"griddepcontrol.launch_dependents", "", [](WarpState&, const PtxInstruction&) {}},
    {"griddepcontrol.wait", "", [](WarpState& w, const PtxInstruction&) { w.early &= ~w.active; }},
    {"bar.sync", "d", nullptr, PtxInstruction::kBarrier},
    {"bar.warp.sync", "d", warp_barrier, PtxInstruction::kWarp},
    {"barrier.cluster.arrive.release.aligned", "",
     [](WarpState& w, const PtxInstruction&) { w.arrival = WarpState::kReleased; }, PtxInstruction::kWarp},
    {"barrier.cluster.arrive.relaxed.aligned", "",
     [](WarpState& w, const PtxInstruction&) { w.arrival = WarpState::kRelaxed; }, PtxInstruction::kWarp},
    {"barrier.cluster.wait.acquire.aligned", "", nullptr, PtxInstruction::kCluster},
    {"shfl.sync.bfly.b32", "dpdddd", shuffle<true>, PtxInstruction::kWarp},
    {"shfl.sync.idx.b32", "dpdddd", shuffle<false>, PtxInstruction::kWarp},
    {"ldmatrix.sync.aligned.m8n8.x4.shared.b16", "dddds", matrices<false>, PtxInstruction::kWarp},
    {"ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16", "dddds", matrices<true>, PtxInstruction::kWarp},
    {"mma.sync.aligned.m16n8k32.row.col.s32.s8.s8.s32", "dddddddddddddd", multiply<mma_s8>, PtxInstruction::kWarp},
    {"mma.sync.aligned.m16n8k16.row.col.f32.bf16.bf16.f32", "dddddddddddddd", multiply<mma_bf16>,
     PtxInstruction::kWarp},
};
}  // namespace

const PtxOperation* find_operation(const std::string& name) {
  static const std::unordered_map<std::string, PtxOperation> all = [] {
    std::unordered_map<std::string, PtxOperation> table;
    for (const std::span<const PtxOperation> some :
         {std::span<const PtxOperation>(kOperations), memory_operations(), wgmma_operations()})
      for (const PtxOperation& one : some) table.emplace(one.name, one);
    return table;
  }();
  const auto found = all.find(name);
  return found == all.end() ? nullptr : &found->second;
}

}  // namespace vla::test::cuda
