// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

/// The instructions of AVX-512 BF16 in plain C++, as avx512_emulation.h does the other vectors.
/// Source: Intel 64 and IA-32 Architectures Software Developer's Manual, volume 2, VDPBF16PS and its neighbours.
#include "support/avx512_emulation.h"

#include <cstdint>

namespace vla::test::bf16 {

using avx512::Words;
constexpr int kHigh = static_cast<int>(0xffff0000U);

/// Subnormal numbers are zero, in and out.
VLA_UNWATCHED inline float flush(float x) { return __builtin_fabsf(x) < 0x1p-126f ? __builtin_copysignf(0.0f, x) : x; }
VLA_UNWATCHED inline float multiply_add(float a, float b, float c) {
  return flush(__builtin_fmaf(flush(a), flush(b), flush(c)));
}

/// Numbers of `low` and then of `high` to the nearest bf16, ties to even; subnormal numbers are zero.
VLA_UNWATCHED VLA_CALLED __m512bh round_pairs(const __m512& high, const __m512& low) {
  std::uint16_t rounded[32];
  for (int i = 0; i < 32; ++i) {
    const float x = i < 16 ? low[i] : high[i - 16];
    const auto bits = __builtin_bit_cast(std::uint32_t, flush(x));
    rounded[i] = static_cast<std::uint16_t>(x != x ? bits >> 16 | 64 : (bits + 0x7fff + (bits >> 16 & 1)) >> 16);
  }
  return __builtin_bit_cast(__m512bh, rounded);
}

inline __m256bh round_half_as_many(__m512 x) {
  const __m512bh rounded = round_pairs(x, x);
  __m256bh half;
  std::memcpy(&half, &rounded, sizeof(half));
  return half;
}

/// sum += the products of both numbers of each pair.
VLA_UNWATCHED VLA_CALLED __m512 add_pairs(const __m512& before, const __m512bh& a, const __m512bh& b) {
  __m512 sum = before;
  const auto words_a = __builtin_bit_cast(Words, a), words_b = __builtin_bit_cast(Words, b);
  const __m512 odd_a = __builtin_bit_cast(__m512, words_a & kHigh), odd_b = __builtin_bit_cast(__m512, words_b & kHigh);
  const __m512 even_a = __builtin_bit_cast(__m512, words_a << 16), even_b = __builtin_bit_cast(__m512, words_b << 16);
  for (int i = 0; i < 16; ++i) {
    sum[i] = multiply_add(odd_a[i], odd_b[i], sum[i]);
    sum[i] = multiply_add(even_a[i], even_b[i], sum[i]);
  }
  return sum;
}

}  // namespace vla::test::bf16

#define _mm512_cvtne2ps_pbh vla::test::bf16::round_pairs
#define _mm512_cvtneps_pbh vla::test::bf16::round_half_as_many
#define _mm512_dpbf16_ps vla::test::bf16::add_pairs
