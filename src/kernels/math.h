// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/vec.h"

/// Transcendental functions of a vector of float32, in float32 throughout. `V` is a type of vec.h.
namespace vla::kernels {

/// 2^n for integers -127 <= n <= 127; -127 gives zero.
template <class V>
VLA_INLINE typename V::Float power_of_two(typename V::Int n) {
  return std::bit_cast<typename V::Float>((n + 127) << 23);
}

/// e^x for x <= 0, as softmax needs it; zero below -87.68, where it leaves the normal floats. x = n ln 2 + rest with
/// |rest| <= ln2 / 2. ln 2 is split into two constants so that the rest is exact to float32.
template <class V>
VLA_INLINE typename V::Float exp_of_negative(typename V::Float x) {
  using Float = typename V::Float;
  constexpr float kShift = 0x1.8p23f;
  x = V::max(V::set(-88.0f), x);
  const Float shifted = V::fma(x, V::set(1.44269504f), V::set(kShift)), whole = shifted - kShift;
  const Float rest = V::fma(whole, V::set(0x1.05c61p-29f), V::fma(whole, V::set(-0x1.62e43p-1f), x));
  // Minimax: relative error 2^-28 of e^rest.
  Float p = V::fma(rest, V::set(1.3814540579915047e-3f), V::set(8.36874544620514e-3f));
  p = V::fma(p, rest, V::set(4.166838899254799e-2f));
  p = V::fma(p, rest, V::set(1.666652113199234e-1f));
  p = V::fma(p, rest, V::set(4.999999403953552e-1f));
  p = V::fma(p, rest * rest, rest);
  return (p + 1.0f) * power_of_two<V>(std::bit_cast<typename V::Int>(shifted) - std::bit_cast<std::int32_t>(kShift));
}

/// |x|; a NaN stays NaN.
template <class V>
VLA_INLINE typename V::Float size_of(typename V::Float x) {
  return std::bit_cast<typename V::Float>(std::bit_cast<typename V::Int>(x) & 0x7fffffff);
}

/// SiLU and GELU's tanh form are x / (1 + 2^-s) with s = x (a + b x^2). With y = |x| and s at y this equals
///     max(x, 0) - y / (1 + 2^s),
/// whose last step rounds once, also for subnormal results. There 2^s grows to 2^158, so the divisor is scaled by kUnit
/// to stay within the normal floats.
///
/// An error of s is a relative error of 2^s. Therefore the integer part n of s is subtracted before anything is
/// rounded: one fused multiply-add computes the product and -n, and the rounding errors of its factors are added to the
/// small rest.
namespace sigmoid {

constexpr float kUnit = 0x1p-40f;
/// Adding it to a small number rounds the number to an integer n and leaves the exponent of 2^n kUnit in the lowest
/// bits.
constexpr float kShift = 0x1.8p23f + 127 - 40;

/// min(|x|, limit). NaN stays NaN.
template <class V>
VLA_INLINE typename V::Float size_within(typename V::Float x, float limit) {
  return V::min(V::set(limit), size_of<V>(x));
}

/// p in 2^rest = 1 + rest p for |rest| <= 0.53, minimax: relative error 2^-27 of 2^rest.
template <class V>
VLA_INLINE typename V::Float slope_of_power(typename V::Float rest) {
  typename V::Float p = V::fma(rest, V::set(0x1.439136p-13f), V::set(0x1.5facf6p-10f));
  p = V::fma(p, rest, V::set(0x1.3b296ap-7f));
  p = V::fma(p, rest, V::set(0x1.c6adcp-5f));
  p = V::fma(p, rest, V::set(0x1.ebfbe4p-3f));
  return V::fma(p, rest, V::set(0x1.62e432p-1f));
}

/// max(x, 0) - y / (1 + 2^(n + rest)) with |rest| <= 0.53, 0 <= n <= 160 and `shifted` = n + kShift. At the limit of y
/// it subtracts zero, because a quotient that underflows costs hundreds of cycles.
template <class V>
VLA_INLINE typename V::Float multiply(typename V::Float x, typename V::Float y, float limit, typename V::Float shifted,
                                      typename V::Float rest) {
  using Float = typename V::Float;
  const Float p = slope_of_power<V>(rest);
  // From n = 24 on, 2^n + 1 rounds to 2^n. `lost` adds the missing 1 through the product with p; 1.625 stands for
  // 1 / p, which is 1.2 to 1.7.
  const Float power = std::bit_cast<Float>(std::bit_cast<typename V::Int>(shifted) << 23), sum = power + kUnit;
  const Float lost = V::fma(sum - power, V::set(-1.625f), V::set(1.625f * kUnit));
  const Float divisor = V::fma(p, V::fma(rest, power, lost), sum);
  const Float positive = V::max(x * 0.0f, x);  // x itself if it is not finite
  const Float dividend = y < limit ? y : Float{};
  return V::fma(V::divide(dividend, divisor), V::set(-kUnit), positive);
}

}  // namespace sigmoid

/// max(x, 0), and NaN for NaN. Source: torch relu.
template <class V>
VLA_INLINE typename V::Float relu(typename V::Float x) {
  return V::max(typename V::Float{}, x);
}

/// max(x, 0)^2, and NaN for NaN.
template <class V>
VLA_INLINE typename V::Float relu_squared(typename V::Float x) {
  return relu<V>(x) * relu<V>(x);
}

/// x * tanh(ln(1 + e^x)), within four units in the last place down to -80, where it is 1e-33. With t = e^-|x| the
/// factor is (1 + 2 t) / (1 + 2 t + 2 t^2) for x >= 0, and (t^2 + 2 t) / (t^2 + 2 t + 2) below, so that nothing
/// cancels. Source: torch mish.
template <class V>
VLA_INLINE typename V::Float mish(typename V::Float x) {
  using Float = typename V::Float;
  const Float t = exp_of_negative<V>(-size_of<V>(x)), twice = t + t;
  const Float above = x < 0.0f ? V::fma(t, t, twice) : twice + 1.0f;
  const Float rest = x < 0.0f ? V::set(2.0f) : twice * t;
  return x * V::divide(above, above + rest);
}

/// x / (1 + e^-x), within two units in the last place over the whole range. Source: torch silu.
template <class V>
VLA_INLINE typename V::Float silu(typename V::Float x) {
  using Float = typename V::Float;
  constexpr float kLimit = 109.0f;  // beyond this the results are x and zero
  const Float y = sigmoid::size_within<V>(x, kLimit);
  const Float a = V::set(0x1.715476p+0f), low_a = V::set(0x1.4ae0cp-26f);
  const Float shifted = V::fma(y, a, V::set(sigmoid::kShift));
  const Float rest = V::fma(y, low_a, V::fma(y, a, sigmoid::kShift - shifted));
  return sigmoid::multiply<V>(x, y, kLimit, shifted, rest);
}

/// x / 2 * (1 + tanh(u)) with u = sqrt(2/pi) (x + 0.044715 x^3), which is x / (1 + e^-2u); as exact as silu().
/// Source: torch gelu(approximate="tanh").
template <class V>
VLA_INLINE typename V::Float gelu_tanh(typename V::Float x) {
  using Float = typename V::Float;
  constexpr float kLimit = 10.8f;  // beyond this the results are x and zero
  const Float y = sigmoid::size_within<V>(x, kLimit);
  // y^2, a and b are split in two parts. The first parts have few enough bits for an exact a + b y^2.
  constexpr float kCoarse = 0x1.8p18f;  // adding this constant rounds to a multiple of 2^-5
  const Float square = V::fma(y, y, V::set(kCoarse)) - kCoarse, low_square = V::fma(y, y, -square);
  const Float factor = V::fma(square, V::set(0x1.a5ap-4f), V::set(0x1.26aecp+1f));
  Float low_factor = V::fma(square, V::set(0x1.f3dd5cp-18f), V::set(0x1.0de73ap-22f));
  low_factor = V::fma(low_square, V::set(0x1.a5a7dp-4f), low_factor);
  const Float shifted = V::fma(y, factor, V::set(sigmoid::kShift));
  const Float rest = V::fma(y, low_factor, V::fma(y, factor, sigmoid::kShift - shifted));
  return sigmoid::multiply<V>(x, y, kLimit, shifted, rest);
}

/// 2^x for results that are rounded to bf16 afterwards: relative error 2^-18, zero for minus infinity, NaN for NaN.
template <class V>
VLA_INLINE typename V::Float exp2_for_bf16(typename V::Float x) {
  const typename V::Float rest = V::fraction(x);
  // Minimax on 0 <= rest <= 1, equal to 1 at 0, so that integer powers of two are exact.
  typename V::Float p = V::fma(rest, V::set(0x1.b7f842p-7f), V::set(0x1.abf784p-5f));
  p = V::fma(p, rest, V::set(0x1.ee248cp-3f));
  p = V::fma(p, rest, V::set(0x1.62d6c2p-1f));
  p = V::fma(p, rest, V::set(1.0f));
  return V::times_power_of_two(p, x);
}

/// silu() and gelu_tanh() for results that are rounded to bf16 afterwards: relative error 2^-13.
template <class V>
VLA_INLINE typename V::Float silu_for_bf16(typename V::Float x) {
  return x * V::reciprocal(exp2_for_bf16<V>(x * -1.44269504f) + 1.0f);
}
template <class V>
VLA_INLINE typename V::Float gelu_tanh_for_bf16(typename V::Float x) {
  constexpr float kLinear = 2.3022082f;  // 2 sqrt(2/pi) / ln 2
  const typename V::Float factor = V::fma(x * x, V::set(-0.044715f * kLinear), V::set(-kLinear));
  return x * V::reciprocal(exp2_for_bf16<V>(x * factor) + 1.0f);
}

}  // namespace vla::kernels
