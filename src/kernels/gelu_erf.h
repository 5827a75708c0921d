// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/math.h"

/// GELU by its definition: x Phi(x), where Phi is the normal distribution function. With y = |x| it is
///     max(x, 0) - g(y) e^(-y^2/2),    g(y) = y erfcx(y / sqrt(2)) / 2,
/// where g rises from 0 to 1 / sqrt(2 pi). The negative tail keeps its relative accuracy as long as the result is a
/// normal number; 1 + erf would lose it below -3.
namespace vla::kernels {

namespace normal_tail {

/// Piecewise minimax approximation of g: relative error 2^-25.7. Pieces of y end at 0.5, 1, 2, 3, 5, 7, 11 and 15,
/// where the exponent and first bit of 1 + y change; these bits are the index, so [0, 0.5] is row seven. In a piece g =
/// start + slope y + sum of c[i] (y - center)^(i + 1). `center` is a point near the middle where g equals a float32 to
/// within 2^-34, so `start` has no rounding error. Near zero g is y / 2 plus terms of y^2.
struct Pieces {
  float center[8], slope[8], start[8], c[7][8];
};
inline constexpr Pieces kPieces = {
    {0x1.8000f8p+0f, 0x1.4003acp+1f, 0x1.000418p+2f, 0x1.800172p+2f, 0x1.1ffe3ep+3f, 0x1.9ffc8cp+3f, 0, 0x1.7fff6ep-1f},
    {0, 0, 0, 0, 0, 0, 0.5f, 0},
    {0x1.3c1486p-2f, 0x1.69cfb4p-2f, 0x1.82b556p-2f, 0x1.8e012p-2f, 0x1.93a64p-2f, 0x1.962424p-2f, 0, 0x1.cd27d2p-3f},
    {{0x1.203f0ep-4f, 0x1.bf2edp-6f, 0x1.2dcdeep-7f, 0x1.a0ea9ap-9f, 0x1.0b72a8p-10f, 0x1.6fe534p-12f, 0,
      0x1.5bf872p-3f},
     {-0x1.331f1ep-5f, -0x1.789232p-7f, -0x1.78eac8p-9f, -0x1.7b54dp-11f, -0x1.54b6fap-13f, -0x1.4bf828p-15f,
      -0x1.98844p-2f, -0x1.c2c7bcp-4f},
     {0x1.0d5fbep-6f, 0x1.0ab8a6p-8f, 0x1.9429f2p-11f, 0x1.2ca76ap-13f, 0x1.7dcb82p-16f, 0x1.08d1ecp-18f,
      0x1.fff9fap-3f, 0x1.d68d7ep-5f},
     {-0x1.9ea364p-8f, -0x1.513d6ep-10f, -0x1.889a6cp-13f, -0x1.b5fb6ap-16f, -0x1.8b74aep-19f, -0x1.899844p-22f,
      -0x1.1009f6p-3f, -0x1.a88d92p-6f},
     {0x1.216168p-9f, 0x1.87e718p-12f, 0x1.63d72p-15f, 0x1.2cd466p-18f, 0x1.85e8acp-22f, 0x1.176874p-25f,
      0x1.f892f2p-5f, 0x1.571ac6p-7f},
     {-0x1.85fb7ep-11f, -0x1.b6f8dcp-14f, -0x1.4baf04p-17f, -0x1.9e7492p-21f, -0x1.9d2e6ap-25f, -0x1.954a3ep-29f,
      -0x1.84d66ep-6f, -0x1.0147fcp-8f},
     {0x1.de6424p-13f, 0x1.c5ec44p-16f, 0x1.14951p-19f, 0x1.08d81ep-23f, 0x1.86070ep-28f, 0x1.1296dp-32f,
      0x1.740144p-8f, 0x1.64fcc8p-10f}},
};

}  // namespace normal_tail

/// x Phi(x), within two units in the last place over the whole range, also for subnormal results. Minus infinity gives
/// NaN. Source: torch gelu(approximate="none").
template <class V>
VLA_INLINE typename V::Float gelu_erf(typename V::Float x) {
  using Float = typename V::Float;
  using Int = typename V::Int;
  using normal_tail::kPieces;
  // Keeps products with e^(-y^2/2) scaled by 2^64, so that only the last step can leave the normal floats.
  constexpr float kUnit = 0x1p-64f, kShift = 0x1.8p23f + 127 + 64;
  constexpr float kCoarse = 0x1.8p18f;  // adding it rounds to a multiple of 2^-5
  const Float size = size_of<V>(x), y = V::min(V::set(14.5f), size);

  // y^2 log2(e) / 2 = n - rest. y^2 and the factor are split in two parts, so that the product of their first parts is
  // exact.
  const Float square = V::fma(y, y, V::set(kCoarse)) - kCoarse, low_square = V::fma(y, y, -square);
  const Float a = V::set(-0x1.714p-1f), low_a = V::set(-0x1.47652cp-13f);
  const Float shifted = V::fma(square, a, V::set(kShift));
  const Float low = V::fma(low_square, V::set(-0x1.715476p-1f), square * low_a);
  const Float rest = V::fma(square, a, kShift - shifted) + low;
  const Float power = std::bit_cast<Float>(std::bit_cast<Int>(shifted) << 23);  // 2^-n / kUnit

  const Int piece = std::bit_cast<Int>(y + 1.0f) >> 22;
  const Float beside = y - V::look_up(kPieces.center, piece);
  Float q = V::look_up(kPieces.c[6], piece);
#pragma GCC unroll 6
  for (int i = 5; i >= 0; --i) q = V::fma(q, beside, V::look_up(kPieces.c[i], piece));
  const Float base = V::fma(V::look_up(kPieces.slope, piece), y, V::look_up(kPieces.start, piece));

  // The parts of g and 2^rest beyond `base` and 1 are small, and so are their rounding errors.
  const Float r = q * beside, more = V::fma(rest * sigmoid::slope_of_power<V>(rest), base + r, r);
  const Float tail = V::fma(power, more, power * base);
  return V::fma(tail, V::set(-kUnit), V::fma(V::set(0.5f), size, 0.5f * x));
}

/// The same for results that are rounded to bf16 afterwards: relative error 2^-13.
template <class V>
VLA_INLINE typename V::Float gelu_erf_for_bf16(typename V::Float x) {
  using Float = typename V::Float;
  const Float size = size_of<V>(x), y = V::min(V::set(13.2f), size);
  // g = y t p(t), minimax: relative error 2^-15.8, and the reciprocal's times 1.16.
  const Float t = V::reciprocal(V::fma(y, V::set(0.925f), V::set(1.0f)));
  Float p = V::fma(t, V::set(0x1.18cbd4p-2f), V::set(-0x1.2f5216p+0f));
  p = V::fma(p, t, V::set(0x1.02dc1cp+1f));
  p = V::fma(p, t, V::set(-0x1.8feef4p+0f));
  p = V::fma(p, t, V::set(0x1.d086aap-3f));
  p = V::fma(p, t, V::set(0x1.6ab44ep-2f));
  p = V::fma(p, t, V::set(0x1.7a5e16p-2f));
  const Float power = exp2_for_bf16<V>(y * y * -0.72134752f);
  return V::fma(-(y * t * p), power, V::fma(V::set(0.5f), size, 0.5f * x));
}

}  // namespace vla::kernels
