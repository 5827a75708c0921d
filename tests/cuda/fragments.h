// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <bit>
#include <cmath>
#include <cstring>

#include "cuda/shared_memory.h"

/// Instructions of a warp on the registers of its lanes: [register][lane].
/// Source: PTX ISA 9.0, "Matrix fragments for mma.m16n8k32", "... for mma.m16n8k16 with floating point type",
/// "ldmatrix".
namespace vla::test::cuda {

using Lanes = std::uint32_t[kWarp];

inline float bf16_to_float(std::uint32_t half) { return std::bit_cast<float>(half << 16); }
inline std::uint32_t float_to_bf16(float x) {
  const auto bits = std::bit_cast<std::uint32_t>(x);
  return std::isnan(x) ? 0x7fffU : (bits + 0x7fff + (bits >> 16 & 1)) >> 16;
}

/// sums[16][8] += rows[16][kDepth] * columns[kDepth][8], in order of the depth.
template <int kDepth>
inline void add_products(float (&sums)[16][8], const float (&rows)[16][kDepth], const float (&columns)[kDepth][8]) {
  typedef float Eight __attribute__((vector_size(32)));
  for (int i = 0; i < 16; i += 4) {
    Eight four[4];
    std::memcpy(four, sums[i], sizeof(four));
    for (int k = 0; k < kDepth; ++k) {
      Eight column;
      std::memcpy(&column, columns[k], sizeof(column));
      for (int r = 0; r < 4; ++r) four[r] += rows[i + r][k] * column;
    }
    std::memcpy(sums[i], four, sizeof(four));
  }
}

/// mma.m16n8k32 of signed bytes. In float32, which compilers vectorize: sums of 32 products stay below 2^20, thus
/// exact.
inline void mma_s8(Lanes* to, const Lanes* a, const Lanes* b, const Lanes* sum) {
  ++counts.mma;
  alignas(32) float rows[16][32], columns[32][8], products[16][8] = {};
  const auto byte = [](std::uint32_t word, int i) {
    return static_cast<float>(static_cast<std::int8_t>(word >> 8 * i));
  };
  for (int l = 0; l < kWarp; ++l)
    for (int i = 0; i < 16; ++i) {  // byte i of the lane's registers
      const int k = l % 4 * 4 + i % 4;
      rows[l / 4 + (i / 4 % 2 ? 8 : 0)][k + (i >= 8 ? 16 : 0)] = byte(a[i / 4][l], i % 4);
      if (i < 8) columns[k + (i >= 4 ? 16 : 0)][l / 4] = byte(b[i / 4][l], i % 4);
    }
  add_products(products, rows, columns);
  for (int l = 0; l < kWarp; ++l)
    for (int c = 0; c < 4; ++c)
      to[c][l] = sum[c][l] +
                 static_cast<std::uint32_t>(static_cast<int>(products[l / 4 + (c >= 2 ? 8 : 0)][l % 4 * 2 + c % 2]));
}

/// mma.m16n8k16 of bf16. A GPU sums the 16 products of an element in an order and with a rounding that NVIDIA does not
/// tell; here each product is exact, and they are added one after the other in float32.
inline void mma_bf16(Lanes* to, const Lanes* a, const Lanes* b, const Lanes* sum) {
  ++counts.mma;
  alignas(32) float rows[16][16], columns[16][8], sums[16][8];
  const auto half = [](std::uint32_t pair, int high) { return bf16_to_float(high ? pair >> 16 : pair & 0xffff); };
  for (int l = 0; l < kWarp; ++l)
    for (int h = 0; h < 2; ++h) {
      const int k = l % 4 * 2 + h;
      for (int r = 0; r < 4; ++r) rows[l / 4 + (r % 2 ? 8 : 0)][k + (r >= 2 ? 8 : 0)] = half(a[r][l], h);
      for (int r = 0; r < 2; ++r) columns[k + (r ? 8 : 0)][l / 4] = half(b[r][l], h);
    }
  const auto place = [&](int l, int c) -> float& { return sums[l / 4 + (c >= 2 ? 8 : 0)][l % 4 * 2 + c % 2]; };
  for (int l = 0; l < kWarp; ++l)
    for (int c = 0; c < 4; ++c) place(l, c) = std::bit_cast<float>(sum[c][l]);
  add_products(sums, rows, columns);
  for (int l = 0; l < kWarp; ++l)
    for (int c = 0; c < 4; ++c) to[c][l] = std::bit_cast<std::uint32_t>(place(l, c));
}

/// ldmatrix.x4: lane 8 j + i has the offset of row i of matrix j in shared memory.
inline void load_matrices(Lanes* to, const std::size_t (&rows)[kWarp], bool transposed, SharedMemory& shared,
                          int warp) {
  ++counts.matrices;
  for (int l = 0; l < kWarp; ++l) shared.read(rows[l], 16, warp * kWarp + l);
  SharedMemory::count_conflicts(rows, 16);
  for (int j = 0; j < 4; ++j)
    for (int l = 0; l < kWarp; ++l) {
      const auto row = [&](int i) { return shared.data() + rows[8 * j + i]; };
      if (!transposed) {
        std::memcpy(&to[j][l], row(l / 4) + l % 4 * 4, 4);
      } else {
        std::uint16_t pair[2];
        for (int h = 0; h < 2; ++h) std::memcpy(&pair[h], row(l % 4 * 2 + h) + l / 4 * 2, 2);
        std::memcpy(&to[j][l], pair, 4);
      }
    }
}

}  // namespace vla::test::cuda
