// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

/// The AVX-512 intrinsics that the kernels use, lane by lane in plain C++, so that a machine without those instructions
/// compiles and checks the same kernels. tests/CMakeLists.txt includes it in front of the kernels' sources.
/// Masks that the kernels always give as ones are not looked at.
/// Source: Intel 64 and IA-32 Architectures Software Developer's Manual, volume 2.
#include <immintrin.h>

#include <bit>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>

#include "support/unwatched.h"

/// For what kernels unroll: calls compile in a third of the time that a copy in every place takes. Arguments are
/// references, because GCC 12 does not align vectors that a machine without the registers is given on the stack.
#define VLA_CALLED __attribute__((noinline)) inline

namespace vla::test::avx512 {

typedef int Words __attribute__((vector_size(64)));
typedef unsigned char Bytes __attribute__((vector_size(64)));
typedef signed char SignedBytes __attribute__((vector_size(64)));

inline __m512 load(const void* p) {
  __m512 x;
  std::memcpy(&x, p, sizeof(x));
  return x;
}
inline __m512i load_words(const void* p) { return std::bit_cast<__m512i>(load(p)); }
inline void store(float* p, __m512 x) { std::memcpy(p, &x, sizeof(x)); }
inline void store_words(void* p, __m512i x) { std::memcpy(p, &x, sizeof(x)); }
/// A masked load does not touch what it leaves out.
VLA_CALLED __m512 load_some(unsigned mask, const float* p) {
  __m512 x = {};
  for (int i = 0; i < 16; ++i)
    if ((mask >> i & 1) != 0) x[i] = p[i];
  return x;
}
VLA_CALLED void store_some(float* p, unsigned mask, const __m512& x) {
  for (int i = 0; i < 16; ++i)
    if ((mask >> i & 1) != 0) p[i] = x[i];
}

inline __m512 set(float x) { return x - __m512{}; }
inline __m512i set_word(int x) { return std::bit_cast<__m512i>(x - Words{}); }
inline __m512 add(__m512 a, __m512 b) { return a + b; }
inline __m512i both(__m512i a, __m512i b) { return a & b; }
VLA_UNWATCHED VLA_CALLED __m512 fma(const __m512& a, const __m512& b, const __m512& c) {
  __m512 y;
  for (int i = 0; i < 16; ++i) y[i] = __builtin_fmaf(a[i], b[i], c[i]);
  return y;
}
/// Of a number and NaN the second, as of equal ones.
VLA_UNWATCHED VLA_CALLED __m512 max(unsigned, const __m512& a, const __m512& b) {
  __m512 y;
  for (int i = 0; i < 16; ++i) y[i] = a[i] > b[i] ? a[i] : b[i];
  return y;
}
/// Of the 32 numbers of a and b the one that each number of `choice` names.
VLA_UNWATCHED VLA_CALLED __m512 choose(const __m512& a, const __m512i& choice, const __m512& b) {
  const auto from = __builtin_bit_cast(Words, choice);
  __m512 y;
  for (int i = 0; i < 16; ++i) y[i] = (from[i] & 16) == 0 ? a[from[i] & 15] : b[from[i] & 15];
  return y;
}
/// x less the whole number below it, and zero of infinity: what `how` = 1 asks for.
VLA_UNWATCHED VLA_CALLED __m512 reduce(unsigned, const __m512& x, int how) {
  if (how != 1) std::abort();
  __m512 y;
  for (int i = 0; i < 16; ++i) y[i] = __builtin_isinf(x[i]) ? 0.0f : x[i] - __builtin_floorf(x[i]);
  return y;
}
/// y times two in the power of the whole number below x. An infinite x decides even where y is NaN.
VLA_UNWATCHED VLA_CALLED __m512 scale(unsigned, const __m512& y, const __m512& x) {
  __m512 scaled;
  for (int i = 0; i < 16; ++i)
    scaled[i] = __builtin_isinf(x[i]) ? (x[i] > 0 ? x[i] : 0.0f)
                                      : static_cast<float>(y[i] * __builtin_exp2(double{__builtin_floorf(x[i])}));
  return scaled;
}
VLA_UNWATCHED VLA_CALLED __m512 min(unsigned, const __m512& a, const __m512& b) {
  __m512 y;
  for (int i = 0; i < 16; ++i) y[i] = a[i] < b[i] ? a[i] : b[i];
  return y;
}
/// 1 / x, cut off where the instruction may end: 2^-14 away, and exact for powers of two. For x and 1 / x normal.
inline __m512 reciprocal(unsigned, __m512 x) {
  return std::bit_cast<__m512>(std::bit_cast<Words>(1.0f / x) & static_cast<int>(0xfffffe00U));
}
/// sum += the products of four bytes, those of `a` without sign, those of `b` with one.
VLA_UNWATCHED VLA_CALLED __m512i dot_bytes(const __m512i& sum, const __m512i& a, const __m512i& b) {
  auto y = __builtin_bit_cast(Words, sum);
  const auto first = __builtin_bit_cast(Bytes, a);
  const auto second = __builtin_bit_cast(SignedBytes, b);
  for (std::size_t i = 0; i < 64; ++i) y[i / 4] += first[i] * second[i];
  return __builtin_bit_cast(__m512i, y);
}
inline __m512i shift_left(unsigned, __m512i x, int n) { return std::bit_cast<__m512i>(std::bit_cast<Words>(x) << n); }
inline __m256 half(unsigned, __m512 x, int i) {
  __m256 y;
  std::memcpy(&y, reinterpret_cast<const float*>(&x) + 8 * i, sizeof(y));
  return y;
}
VLA_UNWATCHED VLA_CALLED __m512 widen(unsigned, const __m256i& x) {
  const __m256 y[2] = {_mm256_cvtph_ps(_mm256_castsi256_si128(x)), _mm256_cvtph_ps(_mm256_extracti128_si256(x, 1))};
  return load(y);
}

}  // namespace vla::test::avx512

#define _mm512_load_ps vla::test::avx512::load
#define _mm512_loadu_ps vla::test::avx512::load
#define _mm512_maskz_loadu_ps vla::test::avx512::load_some
#define _mm512_storeu_si512 vla::test::avx512::store_words
#define _mm512_setzero_si512() vla::test::avx512::set_word(0)
#define _mm512_dpbusd_epi32 vla::test::avx512::dot_bytes
#define _mm512_loadu_si512 vla::test::avx512::load_words
#define _mm512_storeu_ps vla::test::avx512::store
#define _mm512_mask_storeu_ps vla::test::avx512::store_some
#define _mm512_store_si512 vla::test::avx512::store_words
#define _mm512_set1_ps vla::test::avx512::set
#define _mm512_setzero_ps() vla::test::avx512::set(0)
#define _mm512_set1_epi32 vla::test::avx512::set_word
#define _mm512_add_ps vla::test::avx512::add
#define _mm512_and_si512 vla::test::avx512::both
#define _mm512_fmadd_ps vla::test::avx512::fma
#define _mm512_maskz_max_ps vla::test::avx512::max
#define _mm512_permutex2var_ps vla::test::avx512::choose
#define _mm512_maskz_reduce_ps vla::test::avx512::reduce
#define _mm512_maskz_scalef_ps vla::test::avx512::scale
#define _mm512_maskz_min_ps vla::test::avx512::min
#define _mm512_maskz_rcp14_ps vla::test::avx512::reciprocal
#define _mm512_maskz_slli_epi32 vla::test::avx512::shift_left
#define _mm512_maskz_extractf32x8_ps vla::test::avx512::half
#define _mm512_maskz_cvtph_ps vla::test::avx512::widen

// What the sources ask the compiler for.
#if !defined(__AVX512F__)
#define __AVX512F__ 1
#define __AVX512DQ__ 1
#endif
#define VLA_EMULATED_INSTRUCTIONS
#define asm(...) static_cast<void>(0)  // a hint that names a register of 64 bytes
#define Avx512 EmulatedAvx512

#include "support/emulated_names.h"
