// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// Loops of multiply-adds on registers, one for each instruction set (probe/peak_probes.cpp). Each function is compiled
// for the instructions it names and runs only on machines that have them.
#include <immintrin.h>

#include "kernels/machine_kernels.h"

namespace vla::kernels {
namespace {

thread_local volatile float sink;  // stored so that the compiler must compute it

/// Factors that keep every sum finite and normal: x <- 0.999 x + 0.001 tends to 1.
constexpr float kFactor = 0.999f, kTerm = 0.001f;

[[gnu::target("avx2,fma")]] void multiply_add_avx2(long n_round) {
  const __m256 factor = _mm256_set1_ps(kFactor), term = _mm256_set1_ps(kTerm);
  __m256 sums[12];
#pragma GCC unroll 12
  for (int i = 0; i < 12; ++i) sums[i] = _mm256_set1_ps(static_cast<float>(i));
  for (; n_round > 0; --n_round)
#pragma GCC unroll 12
    for (__m256& s : sums) s = _mm256_fmadd_ps(s, factor, term);
  for (const __m256& s : sums) sink = _mm256_cvtss_f32(s);
}

[[gnu::target("avx512f")]] void multiply_add_avx512(long n_round) {
  const __m512 factor = _mm512_set1_ps(kFactor), term = _mm512_set1_ps(kTerm);
  __m512 sums[28];
#pragma GCC unroll 28
  for (int i = 0; i < 28; ++i) sums[i] = _mm512_set1_ps(static_cast<float>(i));
  for (; n_round > 0; --n_round)
#pragma GCC unroll 28
    for (__m512& s : sums) s = _mm512_fmadd_ps(s, factor, term);
  for (const __m512& s : sums) sink = _mm512_cvtss_f32(s);
}

/// Writes the whole loop in assembly, with `body` once for each of `sums`: with intrinsics, compilers copy every sum,
/// which halves the rate.
// clang-format off
#define VLA_SUM_LOOP(sums, body, ...)                                                       \
  if (n_round <= 0) return;                                                                 \
  __asm__ volatile("1:\n.irp sum, " sums "\n" body ".endr\ndec %0\njnz 1b"                  \
                   : "+r"(n_round) : : "cc", __VA_ARGS__)
#define VLA_16_REGISTERS                                                                    \
  "xmm0", "xmm1", "xmm2", "xmm3", "xmm4", "xmm5", "xmm6", "xmm7", "xmm8", "xmm9", "xmm10",  \
  "xmm11", "xmm12", "xmm13", "xmm14", "xmm15"
#define VLA_32_REGISTERS                                                                    \
  VLA_16_REGISTERS, "xmm16", "xmm17", "xmm18", "xmm19", "xmm20", "xmm21", "xmm22", "xmm23", \
  "xmm24", "xmm25", "xmm26", "xmm27", "xmm28", "xmm29", "xmm30", "xmm31"
#define VLA_12_SUMS "0,1,2,3,4,5,6,7,8,9,10,11"
#define VLA_28_SUMS VLA_12_SUMS ",12,13,14,15,16,17,18,19,20,21,22,23,24,25,26,27"
// clang-format on

[[gnu::target("avx512f")]] void multiply_add_vnni(long n_round) {
  VLA_SUM_LOOP(VLA_28_SUMS, "vpdpbusd %%zmm30, %%zmm31, %%zmm\\sum\n", VLA_32_REGISTERS);
}
[[gnu::target("avx512f")]] void multiply_add_pairs(long n_round) {
  VLA_SUM_LOOP(VLA_28_SUMS, "vdpbf16ps %%zmm30, %%zmm31, %%zmm\\sum\n", VLA_32_REGISTERS);
}

/// Permutations that look up 32 sums of three products, beside VNNI (int8_lookup_avx512.cpp): 96 multiply-adds for each
/// permutation with its addition, and at the same time two VNNI products of 64 multiply-adds.
[[gnu::target("avx512f")]] void multiply_add_lookup(long n_round) {
  VLA_SUM_LOOP("0,1,2,3,4,5,6,7",
               "vpermw %%zmm30, %%zmm31, %%zmm29\n"
               "vpdpbusd %%zmm30, %%zmm31, %%zmm\\sum\n"
               "vpdpbusd %%zmm30, %%zmm31, %%zmm1\\sum\n"
               "vpaddw %%zmm29, %%zmm2\\sum, %%zmm2\\sum\n",
               VLA_32_REGISTERS);
}

/// Pairs of byte products summed to 16 bits: two instructions for 32 multiply-adds.
[[gnu::target("avx2")]] void multiply_add_bytes(long n_round) {
  VLA_SUM_LOOP(VLA_12_SUMS,
               "vpmaddubsw %%ymm14, %%ymm15, %%ymm13\n"
               "vpaddw %%ymm13, %%ymm\\sum, %%ymm\\sum\n",
               VLA_16_REGISTERS);
}
[[gnu::target("avx2")]] void multiply_add_avxvnni(long n_round) {
  VLA_SUM_LOOP(VLA_12_SUMS, "%{vex%} vpdpbusd %%ymm14, %%ymm15, %%ymm\\sum\n", VLA_16_REGISTERS);
}

#undef VLA_SUM_LOOP
#undef VLA_16_REGISTERS
#undef VLA_32_REGISTERS
#undef VLA_12_SUMS
#undef VLA_28_SUMS

/// All eight tiles as 16 rows of 64 bytes, palette 1. Source: Intel Architecture Instruction Set Extensions,
/// chapter on AMX, LDTILECFG.
struct alignas(64) TileConfig {
  std::uint8_t palette = 1, start_row = 0, reserved[14] = {};
  std::uint16_t n_byte[16] = {64, 64, 64, 64, 64, 64, 64, 64};
  std::uint8_t n_row[16] = {16, 16, 16, 16, 16, 16, 16, 16};
};

// constant memory, because the intrinsic does not tell the compiler that it reads the whole configuration
constexpr TileConfig kTiles;

/// Tiles 0 to 5 sum products of tiles 6 and 7, which are zero. With different elements the loop runs at 86 % of this
/// rate on Granite Rapids (docs/performance.md), which is the most that a product can reach.
// clang-format off
#define VLA_TILE_LOOP(multiply_add)                                                \
  _tile_loadconfig(&kTiles);                                                       \
  _tile_zero(0); _tile_zero(1); _tile_zero(2); _tile_zero(3);                      \
  _tile_zero(4); _tile_zero(5); _tile_zero(6); _tile_zero(7);                      \
  for (; n_round > 0; --n_round) {                                                 \
    multiply_add(0, 6, 7); multiply_add(1, 6, 7); multiply_add(2, 6, 7);           \
    multiply_add(3, 6, 7); multiply_add(4, 6, 7); multiply_add(5, 6, 7);           \
  }                                                                                \
  _tile_release()
// clang-format on

[[gnu::target("amx-tile,amx-bf16")]] void multiply_add_amx_bf16(long n_round) { VLA_TILE_LOOP(_tile_dpbf16ps); }
[[gnu::target("amx-tile,amx-int8")]] void multiply_add_amx_int8(long n_round) { VLA_TILE_LOOP(_tile_dpbssd); }

#undef VLA_TILE_LOOP

}  // namespace

std::span<const PeakProbe> machine::peak_probes() {
  constexpr double kTileProduct = 16 * 16 * 32 * 2;  // for bf16; a tile holds twice as many int8
  static const PeakProbe all[] = {
      {"avx2 f32", {Feature::avx2}, Number::f32, 12 * 8 * 2, multiply_add_avx2},
      {"avx2 int8", {Feature::avx2}, Number::int8, 12 * 32 * 2, multiply_add_bytes},
      {"avxvnni int8", {Feature::avx_vnni}, Number::int8, 12 * 32 * 2, multiply_add_avxvnni},
      {"avx512 f32", {Feature::avx512}, Number::f32, 28 * 16 * 2, multiply_add_avx512},
      {"avx512 int8", {Feature::avx512_vnni}, Number::int8, 28 * 64 * 2, multiply_add_vnni},
      {"avx512 lookup", {Feature::permutes_beside_vnni}, Number::ternary, 8 * (2 * 64 + 96) * 2, multiply_add_lookup},
      {"avx512 bf16", {Feature::avx512_bf16}, Number::bf16, 28 * 32 * 2, multiply_add_pairs},
      {"amx bf16", {Feature::amx_bf16}, Number::bf16, 6 * kTileProduct, multiply_add_amx_bf16},
      {"amx int8", {Feature::amx_int8}, Number::int8, 2 * 6 * kTileProduct, multiply_add_amx_int8}};
  return all;
}

}  // namespace vla::kernels
