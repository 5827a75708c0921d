// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <arm_neon.h>

#include "kernels/vec.h"

namespace vla::kernels {

struct Neon : Lanes<4> {
  static VLA_INLINE Float set(float x) { return vdupq_n_f32(x); }
  static VLA_INLINE Float fma(Float a, Float b, Float c) { return vfmaq_f32(c, a, b); }
  // Of a number and NaN the second, where FMIN and FMAX give NaN.
  static VLA_INLINE Float min(Float a, Float b) { return a < b ? a : b; }
  static VLA_INLINE Float max(Float a, Float b) { return a > b ? a : b; }
  static VLA_INLINE float sum(Float x) { return vaddvq_f32(x); }
  static VLA_INLINE float max(Float x) { return vmaxnmvq_f32(x); }
  static VLA_INLINE Float interleave_low(Float a, Float b) { return vzip1q_f32(a, b); }
  static VLA_INLINE Float interleave_high(Float a, Float b) { return vzip2q_f32(a, b); }
  static VLA_INLINE Float look_up(const float (&table)[8], Int index) {
    uint8x16x2_t bytes;
    std::memcpy(&bytes, table, sizeof(bytes));
    const Int four = (index & 7) * 0x04040404 + 0x03020100;  // where the four bytes of a number stand
    return vreinterpretq_f32_u8(vqtbl2q_u8(bytes, std::bit_cast<uint8x16_t>(four)));
  }
};

}  // namespace vla::kernels
