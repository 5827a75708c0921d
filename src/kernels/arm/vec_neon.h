// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <arm_neon.h>

#include "kernels/vec.h"

namespace vla::kernels {

struct Neon : Lanes<4> {
  static VLA_INLINE Float set(float x) { return vdupq_n_f32(x); }
  static VLA_INLINE Float fma(Float a, Float b, Float c) { return vfmaq_f32(c, a, b); }
  // Returns the second operand if the first is NaN; FMIN and FMAX would return NaN.
  static VLA_INLINE Float min(Float a, Float b) { return a < b ? a : b; }
  static VLA_INLINE Float max(Float a, Float b) { return a > b ? a : b; }
  static VLA_INLINE float sum(Float x) { return vaddvq_f32(x); }
  static VLA_INLINE float max(Float x) { return vmaxnmvq_f32(x); }
  static VLA_INLINE Float interleave_low(Float a, Float b) { return vzip1q_f32(a, b); }
  static VLA_INLINE Float interleave_high(Float a, Float b) { return vzip2q_f32(a, b); }
  static VLA_INLINE Float look_up(const float (&table)[8], Int index) {
    uint8x16x2_t bytes;
    std::memcpy(&bytes, table, sizeof(bytes));
    const Int four = (index & 7) * 0x04040404 + 0x03020100;  // position of a number's four bytes
    return vreinterpretq_f32_u8(vqtbl2q_u8(bytes, std::bit_cast<uint8x16_t>(four)));
  }
  /// An 8-bit estimate and one Newton step: relative error 2^-16.
  static VLA_INLINE Float reciprocal(Float x) {
    const Float estimate = vrecpeq_f32(x);
    return estimate * vrecpsq_f32(x, estimate);
  }
  static VLA_INLINE Float fraction(Float x) {
    const Float whole = vrndmq_f32(x);
    return whole == x ? Float{} : x - whole;  // zero for infinity too
  }
  static VLA_INLINE Float times_power_of_two(Float y, Float x) {
    const Int n = vmaxq_s32(vminq_s32(vcvtmq_s32_f32(x), vdupq_n_s32(254)), vdupq_n_s32(-252)), half = n >> 1;
    return y * std::bit_cast<Float>((half + 127) << 23) * std::bit_cast<Float>((n - half + 127) << 23);
  }
};

}  // namespace vla::kernels
