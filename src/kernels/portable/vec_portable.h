// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/vec.h"

namespace vla::kernels {

/// Four lanes on every machine. Its multiply-add computes in double, so that math.h is as exact without a fused
/// instruction.
struct Portable : Lanes<4> {
  static VLA_INLINE Float fma(Float a, Float b, Float c) {
    typedef double Doubles __attribute__((vector_size(8 * width)));
    const auto x = __builtin_convertvector(a, Doubles), y = __builtin_convertvector(b, Doubles);
    return __builtin_convertvector(x * y + __builtin_convertvector(c, Doubles), Float);
  }
  /// `min` and `max` with NaN return the second operand.
  static VLA_INLINE Float min(Float a, Float b) { return a < b ? a : b; }
  static VLA_INLINE Float max(Float a, Float b) { return a > b ? a : b; }
  static VLA_INLINE float max(Float x) {
    float most = x[0];
    for (int i = 1; i < width; ++i) most = x[i] > most ? x[i] : most;
    return most;
  }
  /// Interleaves the lower halves of a and b, and the upper halves.
  static VLA_INLINE Float interleave_low(Float a, Float b) { return Float{a[0], b[0], a[1], b[1]}; }
  static VLA_INLINE Float interleave_high(Float a, Float b) { return Float{a[2], b[2], a[3], b[3]}; }
  /// Looks up each lane in a table by the lowest three bits of its index.
  static VLA_INLINE Float look_up(const float (&table)[8], Int index) {
    Float y;
    for (int i = 0; i < width; ++i) y[i] = table[index[i] & 7];
    return y;
  }
  /// 1 / x with a relative error of at most 2^-14, zero for infinity.
  static VLA_INLINE Float reciprocal(Float x) { return 1.0f / x; }
  /// x - floor(x), and y * 2^floor(x).
  static VLA_INLINE Float fraction(Float x) {
    for (int i = 0; i < width; ++i) x[i] = __builtin_isinf(x[i]) ? 0.0f : x[i] - __builtin_floorf(x[i]);
    return x;
  }
  static VLA_INLINE Float times_power_of_two(Float y, Float x) {
    for (int i = 0; i < width; ++i) y[i] *= __builtin_exp2f(__builtin_floorf(x[i]));
    return y;
  }
};

}  // namespace vla::kernels
