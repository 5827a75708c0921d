// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/vec.h"

/// Transcendental functions of a vector of float32, within two units in the last place of the exact value over the
/// whole range, subnormal results included (tests/kernels/math_test.cpp). `V` is a type of vec.h.
namespace vla::kernels {

/// e^x as (mantissa + low) * first * second. The factors are powers of two that may both be tiny, so that one rounding,
/// and only one, happens where the product becomes subnormal.
template <class V>
struct Exponential {
  typename V::Float mantissa, low, first, second;
};

/// Two in the power of the whole numbers n, -127 <= n <= 127; -127 gives zero.
template <class V>
VLA_INLINE typename V::Float power_of_two(typename V::Int n) {
  return std::bit_cast<typename V::Float>((n + 127) << 23);
}

/// x = n ln 2 + rest with |rest| <= ln2 / 2, and e^rest. Two constants make ln 2, so that the rest is exact to float32.
template <class V>
struct Reduced {
  typename V::Float mantissa, low;  // low is what the mantissa lost in its last rounding
  typename V::Int n;

  /// Of x + low for each `low` that there is, far below 1.
  template <class... Low>
  VLA_INLINE explicit Reduced(typename V::Float x, Low... x_low) {
    using Float = typename V::Float;
    constexpr float kShift = 12582912.0f;  // 1.5 * 2^23: adding it rounds to a whole number, in the low bits
    const Float shifted = V::fma(x, V::set(1.44269504f), V::set(kShift));
    n = std::bit_cast<typename V::Int>(shifted) - std::bit_cast<std::int32_t>(kShift);
    const Float whole = shifted - kShift;
    Float rest = V::fma(whole, V::set(-0x1.62e43p-1f), x);
    rest = (V::fma(whole, V::set(0x1.05c61p-29f), rest) + ... + x_low);
    // Minimax: relative error 2^-28 of the whole.
    Float p = V::fma(rest, V::set(1.3814540579915047e-3f), V::set(8.36874544620514e-3f));
    p = V::fma(p, rest, V::set(4.166838899254799e-2f));
    p = V::fma(p, rest, V::set(1.666652113199234e-1f));
    p = V::fma(p, rest, V::set(4.999999403953552e-1f));
    p = V::fma(p, rest * rest, rest);
    mantissa = p + 1.0f;
    low = p - (mantissa - 1.0f);
  }
};

/// e^(x + x_low) for x <= 89 and |x_low| far below 1; zero from -176.06 down. A NaN gives NaN.
template <class V>
VLA_INLINE Exponential<V> exponential(typename V::Float x, typename V::Float x_low) {
  const Reduced<V> reduced(V::max(V::set(-176.0594f), x), x_low);
  const typename V::Int half = reduced.n >> 1;
  return {reduced.mantissa, reduced.low, power_of_two<V>(half), power_of_two<V>(reduced.n - half)};
}

/// e^x.
template <class V>
VLA_INLINE typename V::Float exp(typename V::Float x) {
  const typename V::Float limit = V::set(89.0f);  // where e^x is infinite already
  const Exponential<V> e = exponential<V>(x > limit ? limit : x, typename V::Float{});
  return e.mantissa * e.first * e.second;
}

/// e^x for x <= 0, zero below -87.68, where it leaves the normal numbers; what a softmax needs, at half the cost.
template <class V>
VLA_INLINE typename V::Float exp_of_negative(typename V::Float x) {
  const Reduced<V> reduced(V::max(V::set(-88.0f), x));
  return reduced.mantissa * power_of_two<V>(reduced.n);
}

/// x / (1 + e^-s), where s has the sign of x, and `minus_s` + `minus_s_low` is -|s|. The exponential is at most 1, so
/// nothing overflows, and for negative x its factors come last, so that only the result is rounded to a subnormal. The
/// quotient of two sums, with what each lost, is rounded once. What is not finite becomes NaN.
template <class V>
VLA_INLINE typename V::Float times_sigmoid(typename V::Float x, typename V::Float minus_s,
                                           typename V::Float minus_s_low) {
  using Float = typename V::Float;
  const Exponential<V> e = exponential<V>(minus_s, minus_s_low);
  const Float one = V::set(1.0f), zero = {};
  const auto negative = x < 0.0f;
  const Float whole = e.mantissa * e.first * e.second;
  const Float below = whole + 1.0f, below_low = whole - (below - 1.0f) + e.low * e.first * e.second;
  const Float factor = negative ? e.mantissa : one;
  const Float above = x * factor, above_low = V::fma(x, factor, -above) + x * (negative ? e.low : zero);
  const Float inverse = one / below, guess = above * inverse;
  const Float missing = V::fma(-guess, below, above) + V::fma(-guess, below_low, above_low);
  return V::fma(missing, inverse, guess) * (negative ? e.first : one) * (negative ? e.second : one);
}

/// |x|
template <class V>
VLA_INLINE typename V::Float magnitude(typename V::Float x) {
  return std::bit_cast<typename V::Float>(std::bit_cast<typename V::Int>(x) & 0x7fffffff);
}

/// x / (1 + e^-x). Source: torch silu.
template <class V>
VLA_INLINE typename V::Float silu(typename V::Float x) {
  return times_sigmoid<V>(x, -magnitude<V>(x), typename V::Float{});
}

/// x / 2 * (1 + tanh(u)) with u = sqrt(2/pi) (x + 0.044715 x^3), which is x / (1 + e^-2u). In the negative tail the
/// result is as wrong as 2u is, absolutely, so 2u is made to twice the precision of float32.
/// Source: torch gelu(approximate="tanh").
template <class V>
VLA_INLINE typename V::Float gelu_tanh(typename V::Float x) {
  using Float = typename V::Float;
  constexpr float kLinear = 0x1.988454p+0f, kLinearLow = -0x1.857936p-25f;  // 2 sqrt(2/pi)
  constexpr float kCubic = 0x1.2444f2p-4f, kCubicLow = 0x1.49b16ap-29f;     // 0.044715 times that
  const Float limit = V::set(14.0f), absolute = magnitude<V>(x);
  const Float a = absolute < limit ? absolute : limit;  // beyond it e^-2u is zero, and a square could overflow
  const Float square = a * a, square_low = V::fma(a, a, -square);
  const Float cubic = square * kCubic;
  const Float cubic_low =
      V::fma(square, V::set(kCubic), -cubic) + V::fma(square, V::set(kCubicLow), square_low * kCubic);
  const Float factor = cubic + kLinear, taken = factor - cubic;  // a sum and, below, exactly what it lost
  const Float factor_low = (cubic - (factor - taken)) + (kLinear - taken) + (cubic_low + kLinearLow);
  const Float s = a * factor, s_low = V::fma(a, factor, -s) + a * factor_low;
  return times_sigmoid<V>(x, -s, -s_low);
}

}  // namespace vla::kernels
