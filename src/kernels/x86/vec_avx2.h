// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <immintrin.h>

#include "kernels/vec.h"

namespace vla::kernels {

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

}  // namespace vla::kernels
