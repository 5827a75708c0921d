// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/x86/vec_avx2.h"

namespace vla::kernels {

// All-ones masks, because GCC 12 warns about undefined lanes in its own header for the unmasked forms.
struct Avx512 : Lanes<16> {
  static VLA_INLINE Float set(float x) { return _mm512_set1_ps(x); }
  static VLA_INLINE Float fma(Float a, Float b, Float c) { return _mm512_fmadd_ps(a, b, c); }
  /// a / b for normal floats, with a relative error of 2^-23.9: an estimate of 1 / b to 2^-14 and one Newton step, in a
  /// third of the time of a division.
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

}  // namespace vla::kernels
