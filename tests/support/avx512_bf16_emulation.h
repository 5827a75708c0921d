// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

/// The instructions of AVX-512 BF16 in plain C++, as avx512_emulation.h does the other vectors.
/// Source: Intel 64 and IA-32 Architectures Software Developer's Manual, volume 2, VDPBF16PS and its neighbours.
#include "support/avx512_emulation.h"

#include <array>
#include <cstdint>

namespace vla::test::bf16 {

/// Subnormal numbers are zero, in and out.
inline float flush(float x) { return std::abs(x) < 0x1p-126f ? std::copysign(0.0f, x) : x; }
inline float multiply_add(float a, float b, float c) { return flush(std::fma(flush(a), flush(b), flush(c))); }

/// Numbers of `low` and then of `high` to the nearest bf16, ties to even; subnormal numbers are zero.
VLA_CALLED __m512bh round_pairs(const __m512& high, const __m512& low) {
  std::uint16_t rounded[32];
  for (int i = 0; i < 32; ++i) {
    const float x = i < 16 ? low[i] : high[i - 16];
    const auto bits = std::bit_cast<std::uint32_t>(flush(x));
    rounded[i] = static_cast<std::uint16_t>(std::isnan(x) ? bits >> 16 | 64 : (bits + 0x7fff + (bits >> 16 & 1)) >> 16);
  }
  return std::bit_cast<__m512bh>(rounded);
}

inline __m256bh round_half_as_many(__m512 x) {
  const __m512bh rounded = round_pairs(x, x);
  __m256bh half;
  std::memcpy(&half, &rounded, sizeof(half));
  return half;
}

/// sum += the products of both numbers of each pair.
VLA_CALLED __m512 add_pairs(const __m512& before, const __m512bh& a, const __m512bh& b) {
  __m512 sum = before;
  const auto words_a = std::bit_cast<std::array<std::uint32_t, 16>>(a);
  const auto words_b = std::bit_cast<std::array<std::uint32_t, 16>>(b);
  for (std::size_t i = 0; i < 16; ++i) {
    const auto odd = [](std::uint32_t word) { return std::bit_cast<float>(word & 0xffff0000U); };
    const auto even = [](std::uint32_t word) { return std::bit_cast<float>(word << 16); };
    sum[i] = multiply_add(odd(words_a[i]), odd(words_b[i]), sum[i]);
    sum[i] = multiply_add(even(words_a[i]), even(words_b[i]), sum[i]);
  }
  return sum;
}

}  // namespace vla::test::bf16

#define _mm512_cvtne2ps_pbh vla::test::bf16::round_pairs
#define _mm512_cvtneps_pbh vla::test::bf16::round_half_as_many
#define _mm512_dpbf16_ps vla::test::bf16::add_pairs
