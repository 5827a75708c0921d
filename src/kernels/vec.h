// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <bit>
#include <cstdint>
#include <cstring>

#if defined(__AVX2__) && defined(__FMA__)
#include <immintrin.h>
#endif

/// Kernels are templates over one of the types below, which is never used outside a file that is compiled for its
/// instructions. Everything they call is forced inline: a function of its own could be merged by the linker with the
/// copy of a file that was compiled for a better machine.
#define VLA_INLINE inline __attribute__((always_inline))
#define VLA_LAMBDA __attribute__((always_inline))  // behind a lambda's parameters

namespace vla::kernels {

/// `W` lanes in the compiler's vector extension. Arithmetic, comparisons and `mask ? a : b` are its operators.
template <int W>
struct Lanes {
  static constexpr int width = W;
  typedef float Float __attribute__((vector_size(4 * W)));
  typedef std::int32_t Int __attribute__((vector_size(4 * W)));

  static VLA_INLINE Float set(float x) { return x - Float{}; }
  static VLA_INLINE Float load(const float* p) {
    Float x;
    std::memcpy(&x, p, sizeof(x));
    return x;
  }
  static VLA_INLINE void store(float* p, Float x) { std::memcpy(p, &x, sizeof(x)); }
  /// The first `n` lanes, 0 <= n <= W, and zeros.
  static VLA_INLINE Float load_part(const float* p, int n) {
    Float x = {};
    std::memcpy(&x, p, static_cast<std::size_t>(n) * sizeof(float));
    return x;
  }
  static VLA_INLINE void store_part(float* p, Float x, int n) {
    std::memcpy(p, &x, static_cast<std::size_t>(n) * sizeof(float));
  }
  static VLA_INLINE Float divide(Float a, Float b) { return a / b; }
  static VLA_INLINE float sum(Float x) {
    float all[W];
    store(all, x);
    for (int step = W / 2; step > 0; step /= 2)
      for (int i = 0; i < step; ++i) all[i] += all[i + step];
    return all[0];
  }
};

/// Four lanes on every machine. Its multiply-add of floats is made in double, so that math.h is as exact where
/// no instruction does.
struct Portable : Lanes<4> {
  static VLA_INLINE Float fma(Float a, Float b, Float c) {
    Float y;
    for (int i = 0; i < width; ++i) y[i] = static_cast<float>(double{a[i]} * double{b[i]} + double{c[i]});
    return y;
  }
  /// Of a number and NaN, `min` and `max` are the second.
  static VLA_INLINE Float min(Float a, Float b) { return a < b ? a : b; }
  static VLA_INLINE Float max(Float a, Float b) { return a > b ? a : b; }
  static VLA_INLINE float max(Float x) {
    float most = x[0];
    for (int i = 1; i < width; ++i) most = x[i] > most ? x[i] : most;
    return most;
  }
  /// The lower halves of a and b in turn, and the upper ones.
  static VLA_INLINE Float interleave_low(Float a, Float b) { return Float{a[0], b[0], a[1], b[1]}; }
  static VLA_INLINE Float interleave_high(Float a, Float b) { return Float{a[2], b[2], a[3], b[3]}; }
  /// Lane by lane the number of a table that the lowest three bits of an index say.
  static VLA_INLINE Float look_up(const float (&table)[8], Int index) {
    Float y;
    for (int i = 0; i < width; ++i) y[i] = table[index[i] & 7];
    return y;
  }
  /// 1 / x with a relative error of at most 2^-14, zero for infinity.
  static VLA_INLINE Float reciprocal(Float x) { return 1.0f / x; }
  /// What x is above the whole number below it, and y times two in the power of that whole number.
  static VLA_INLINE Float fraction(Float x) {
    for (int i = 0; i < width; ++i) x[i] = __builtin_isinf(x[i]) ? 0.0f : x[i] - __builtin_floorf(x[i]);
    return x;
  }
  static VLA_INLINE Float times_power_of_two(Float y, Float x) {
    for (int i = 0; i < width; ++i) y[i] *= __builtin_exp2f(__builtin_floorf(x[i]));
    return y;
  }
};

#if defined(__AVX2__) && defined(__FMA__)
struct Avx2 : Lanes<8> {
  static VLA_INLINE Float set(float x) { return _mm256_set1_ps(x); }
  static VLA_INLINE Float fma(Float a, Float b, Float c) { return _mm256_fmadd_ps(a, b, c); }
  static VLA_INLINE Float min(Float a, Float b) { return _mm256_min_ps(a, b); }
  static VLA_INLINE Float max(Float a, Float b) { return _mm256_max_ps(a, b); }
  static VLA_INLINE float sum(Float x) {
    __m128 y = _mm256_castps256_ps128(x) + _mm256_extractf128_ps(x, 1);
    y += _mm_movehl_ps(y, y);
    return y[0] + y[1];
  }
  static VLA_INLINE float max(Float x) {
    __m128 y = _mm_max_ps(_mm256_castps256_ps128(x), _mm256_extractf128_ps(x, 1));
    y = _mm_max_ps(y, _mm_movehl_ps(y, y));
    return y[0] > y[1] ? y[0] : y[1];
  }
  static VLA_INLINE Float look_up(const float (&table)[8], Int index) {
    return _mm256_permutevar8x32_ps(load(table), std::bit_cast<__m256i>(index));
  }
  static VLA_INLINE Float interleave_low(Float a, Float b) {
    return _mm256_permute2f128_ps(_mm256_unpacklo_ps(a, b), _mm256_unpackhi_ps(a, b), 0x20);
  }
  static VLA_INLINE Float interleave_high(Float a, Float b) {
    return _mm256_permute2f128_ps(_mm256_unpacklo_ps(a, b), _mm256_unpackhi_ps(a, b), 0x31);
  }
};
#endif

#if defined(__AVX512F__) && defined(__AVX512DQ__)
// Whole masks, where an instruction without one would do: GCC 12 warns of the undefined lanes in its own header.
struct Avx512 : Lanes<16> {
  static VLA_INLINE Float set(float x) { return _mm512_set1_ps(x); }
  static VLA_INLINE Float fma(Float a, Float b, Float c) { return _mm512_fmadd_ps(a, b, c); }
  /// For 1 / b among the normal numbers, with a relative error of 2^-23.9: the instruction's 2^-14 and one correction,
  /// in a third of the time of a division.
  static VLA_INLINE Float divide(Float a, Float b) {
    const Float inverse = reciprocal(b), quotient = a * inverse;
    return fma(fma(-quotient, b, a), inverse, quotient);
  }
  static VLA_INLINE Float min(Float a, Float b) { return _mm512_maskz_min_ps(0xffff, a, b); }
  static VLA_INLINE Float max(Float a, Float b) { return _mm512_maskz_max_ps(0xffff, a, b); }
  static VLA_INLINE Float load_part(const float* p, int n) { return _mm512_maskz_loadu_ps(mask(n), p); }
  static VLA_INLINE void store_part(float* p, Float x, int n) { _mm512_mask_storeu_ps(p, mask(n), x); }
  static VLA_INLINE float sum(Float x) { return Avx2::sum(lower(x) + upper(x)); }
  static VLA_INLINE float max(Float x) { return Avx2::max(Avx2::max(lower(x), upper(x))); }
  static VLA_INLINE Float interleave_low(Float a, Float b) {
    return _mm512_permutex2var_ps(
        a, std::bit_cast<__m512i>(Int{0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23}), b);
  }
  static VLA_INLINE Float interleave_high(Float a, Float b) {
    return _mm512_permutex2var_ps(
        a, std::bit_cast<__m512i>(Int{8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31}), b);
  }
  static VLA_INLINE Float look_up(const float (&t)[8], Int index) {
    const Float twice = {t[0], t[1], t[2], t[3], t[4], t[5], t[6], t[7],
                         t[0], t[1], t[2], t[3], t[4], t[5], t[6], t[7]};
    return _mm512_permutex2var_ps(twice, std::bit_cast<__m512i>(index), twice);
  }
  static VLA_INLINE Float reciprocal(Float x) { return _mm512_maskz_rcp14_ps(0xffff, x); }
  static VLA_INLINE Float fraction(Float x) { return _mm512_maskz_reduce_ps(0xffff, x, 1); }  // 1: round down
  static VLA_INLINE Float times_power_of_two(Float y, Float x) { return _mm512_maskz_scalef_ps(0xffff, y, x); }

 private:
  static VLA_INLINE __mmask16 mask(int n) { return static_cast<__mmask16>((1U << n) - 1U); }
  static VLA_INLINE __m256 lower(Float x) { return _mm512_maskz_extractf32x8_ps(0xff, x, 0); }
  static VLA_INLINE __m256 upper(Float x) { return _mm512_maskz_extractf32x8_ps(0xff, x, 1); }
};
#endif

/// A vector from p where `left` numbers remain; lanes beyond them are zeros.
template <class V>
VLA_INLINE typename V::Float load(const float* p, std::int64_t left) {
  return left >= V::width ? V::load(p) : V::load_part(p, static_cast<int>(left));
}
template <class V>
VLA_INLINE void store(float* p, typename V::Float x, std::int64_t left) {
  left >= V::width ? V::store(p, x) : V::store_part(p, x, static_cast<int>(left));
}

/// As many vectors as each has lanes: lane j of vector i and lane i of vector j change places. Each round interleaves
/// vectors half of the square apart.
template <class V>
VLA_INLINE void transpose(typename V::Float (&x)[V::width]) {
  constexpr int kHalf = V::width / 2;
#pragma GCC unroll 4
  for (int size = V::width; size > 1; size /= 2) {
    typename V::Float y[V::width];
#pragma GCC unroll 8
    for (int i = 0; i < kHalf; ++i) {
      y[2 * i] = V::interleave_low(x[i], x[i + kHalf]);
      y[2 * i + 1] = V::interleave_high(x[i], x[i + kHalf]);
    }
#pragma GCC unroll 16
    for (int i = 0; i < V::width; ++i) x[i] = y[i];
  }
}

/// In lane i all of x[i], put together by `join` (a sum, a maximum), which sees numbers in an order of its own.
template <class V, class Join>
VLA_INLINE typename V::Float across(typename V::Float (&x)[V::width], Join join) {
#pragma GCC unroll 4
  for (int n = V::width / 2; n > 0; n /= 2)
#pragma GCC unroll 8
    for (int i = 0; i < n; ++i) x[i] = join(V::interleave_low(x[i], x[i + n]), V::interleave_high(x[i], x[i + n]));
  return x[0];
}

}  // namespace vla::kernels
