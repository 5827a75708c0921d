// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/vec.h"

/// Transcendental functions of a vector of float32, within one unit in the last place of the exact value over the
/// whole range, subnormal results included (tests/kernels/math_test.cpp). `V` is a type of vec.h.
///
/// They are computed in double, one half of the vector after the other, and rounded once: in float32, rounding errors
/// would have to be carried along and ranges watched, which takes longer.
namespace vla::kernels {

/// e^x for |x| <= 700, with a relative error of 2^-29; of NaN anything.
template <class V>
VLA_INLINE typename V::Double exponential(typename V::Double x) {
  using Double = typename V::Double;
  using Long = typename V::Long;
  constexpr double kShift = 0x1.8p52;  // adding it rounds to a whole number, in the low bits
  const Double shifted = V::fma(x, V::set_double(1.4426950408889634), V::set_double(kShift));
  const Double rest = V::fma(shifted - kShift, V::set_double(-0.69314718055994531), x);
  // Minimax on |rest| <= ln2 / 2.
  Double p = V::fma(rest, V::set_double(0x1.6ab96e80e518p-10), V::set_double(0x1.126d1df08560ep-7));
  p = V::fma(p, rest, V::set_double(0x1.55589a99c6e2ep-5));
  p = V::fma(p, rest, V::set_double(0x1.55540a5ba376ep-3));
  p = V::fma(p, rest, V::set_double(0x1.fffffaae7fa8ep-2));
  p = V::fma(p, rest, V::set_double(0x1.0000009c19c3ap+0));
  p = V::fma(p, rest, V::set_double(0x1.0000000261cdfp+0));
  return std::bit_cast<Double>(std::bit_cast<Long>(p) + (std::bit_cast<Long>(shifted) << 52));
}

/// x between -limit and limit; a NaN stays one.
template <class V>
VLA_INLINE typename V::Float within(typename V::Float x, float limit) {
  const typename V::Float most = V::set(limit), least = V::set(-limit);
  x = most < x ? most : x;
  return least > x ? least : x;
}

/// e^x.
template <class V>
VLA_INLINE typename V::Float exp(typename V::Float x) {
  const typename V::Float inner = within<V>(x, 200.0f);  // beyond it the result is infinite or zero
  const typename V::Float e = V::narrow(exponential<V>(V::widen(inner, 0)), exponential<V>(V::widen(inner, 1)));
  return x == x ? e : x;
}

/// Two in the power of the whole numbers n, -127 <= n <= 127; -127 gives zero.
template <class V>
VLA_INLINE typename V::Float power_of_two(typename V::Int n) {
  return std::bit_cast<typename V::Float>((n + 127) << 23);
}

/// e^x for x <= 0, zero below -87.68, where it leaves the normal numbers: what a softmax needs, in float32 throughout.
/// x = n ln 2 + rest with |rest| <= ln2 / 2. Two constants make ln 2, so that the rest is exact to float32.
template <class V>
VLA_INLINE typename V::Float exp_of_negative(typename V::Float x) {
  using Float = typename V::Float;
  constexpr float kShift = 0x1.8p23f;
  x = V::max(V::set(-88.0f), x);
  const Float shifted = V::fma(x, V::set(1.44269504f), V::set(kShift)), whole = shifted - kShift;
  const Float rest = V::fma(whole, V::set(0x1.05c61p-29f), V::fma(whole, V::set(-0x1.62e43p-1f), x));
  // Minimax: relative error 2^-28 of the whole.
  Float p = V::fma(rest, V::set(1.3814540579915047e-3f), V::set(8.36874544620514e-3f));
  p = V::fma(p, rest, V::set(4.166838899254799e-2f));
  p = V::fma(p, rest, V::set(1.666652113199234e-1f));
  p = V::fma(p, rest, V::set(4.999999403953552e-1f));
  p = V::fma(p, rest * rest, rest);
  return (p + 1.0f) * power_of_two<V>(std::bit_cast<typename V::Int>(shifted) - std::bit_cast<std::int32_t>(kShift));
}

/// x / (1 + e^-s), |s| <= 700.
template <class V>
VLA_INLINE typename V::Double times_sigmoid(typename V::Double x, typename V::Double s) {
  return x / (exponential<V>(-s) + 1.0);
}

/// x / (1 + e^-x). Source: torch silu.
template <class V>
VLA_INLINE typename V::Float silu(typename V::Float x) {
  const typename V::Float inner = within<V>(x, 200.0f);  // beyond it the result is x or zero
  return V::narrow(times_sigmoid<V>(V::widen(x, 0), V::widen(inner, 0)),
                   times_sigmoid<V>(V::widen(x, 1), V::widen(inner, 1)));
}

/// 2 sqrt(2/pi) (x + 0.044715 x^3)
template <class V>
VLA_INLINE typename V::Double gelu_slope(typename V::Double x) {
  constexpr double kLinear = 1.5957691216057308;
  return x * V::fma(x * x, V::set_double(kLinear * 0.044715), V::set_double(kLinear));
}

/// x / 2 * (1 + tanh(u)) with u = sqrt(2/pi) (x + 0.044715 x^3), which is x / (1 + e^-2u).
/// Source: torch gelu(approximate="tanh").
template <class V>
VLA_INLINE typename V::Float gelu_tanh(typename V::Float x) {
  const typename V::Float inner = within<V>(x, 20.0f);  // beyond it the result is x or zero
  return V::narrow(times_sigmoid<V>(V::widen(x, 0), gelu_slope<V>(V::widen(inner, 0))),
                   times_sigmoid<V>(V::widen(x, 1), gelu_slope<V>(V::widen(inner, 1))));
}

}  // namespace vla::kernels
