# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The random numbers of a seed, the same bits on every machine and equal to those of torch.Generator().manual_seed(seed).

torch fills 16 numbers or more by Box-Muller on blocks of 16, with polynomials for log, sin and cos in float32; fewer numbers
come one by one from double precision.  Only sums, products and square roots of float32 are used here, which IEEE 754 defines
exactly.  Source: ATen/native/cpu/DistributionTemplates.h (normal_fill_AVX2), ATen/native/cpu/avx_mathfun.h, ATen/core/
DistributionsHelper.h.
"""

import math

import numpy as np

f32 = np.float32
LOG = (7.0376836292e-2, -1.1514610310e-1, 1.1676998740e-1, -1.2420140846e-1, 1.4249322787e-1, -1.6668057665e-1,
       2.0000714765e-1, -2.4999993993e-1, 3.3333331174e-1)
SIN = (-1.9515295891e-4, 8.3321608736e-3, -1.6666654611e-1)
COS = (2.443315711809948e-5, -1.388731625493765e-3, 4.166664568298827e-2)
QUARTER_PI = (-0.78515625, -2.4187564849853515625e-4, -3.77489497744594108e-8)  # in three parts, so that products are exact


def polynomial(x, coefficients):
    y = np.full_like(x, f32(coefficients[0]))
    for c in coefficients[1:]:
        y = y * x + f32(c)
    return y


def log(x):
    mantissa, exponent = np.frexp(x)
    small = mantissa < f32(0.707106781186547524)
    e = exponent.astype(f32) - small
    x = mantissa - f32(1) + np.where(small, mantissa, f32(0))
    z = x * x
    y = polynomial(x, LOG) * x * z + e * f32(-2.12194440e-4) - z * f32(0.5)
    return x + y + e * f32(0.693359375)


def sin_cos(x):
    octant = (x * f32(1.27323954473516)).astype(np.int32) + 1 & ~1
    for part in QUARTER_PI:
        x = x + octant.astype(f32) * f32(part)
    z = x * x
    cos = polynomial(z, COS) * z * z - z * f32(0.5) + f32(1)
    sin = polynomial(z, SIN) * z * x + x
    swap = (octant & 2) != 0
    sin, cos = np.where(swap, cos, sin), np.where(swap, sin, cos)
    return np.where(octant & 4, -sin, sin), np.where(~(octant - 2) & 4, -cos, cos)


class Generator:
    """A stream of random numbers; the calls of one generator follow each other as torch's do."""

    def __init__(self, seed):
        self.words, self.spare = np.random.RandomState(seed & 0xFFFFFFFF), None

    def raw(self, n):
        return np.frombuffer(self.words.bytes(4 * n), "<u4")

    def uniform(self, *shape):
        """float32 in [0, 1)."""
        n = math.prod(shape)
        return ((self.raw(n) & 0xFFFFFF).astype(f32) * f32(2.0**-24)).reshape(shape)

    def normal(self, *shape):
        """Standard normal, float32."""
        n = math.prod(shape)
        if n < 16:
            return np.array([self.one_normal() for _ in range(n)], f32).reshape(shape)
        u = self.uniform(n)
        out = np.empty(n, f32)
        whole = n - n % 16
        out[:whole] = self.box_muller(u[:whole])
        if whole < n:  # the last 16 are drawn again, which replaces some of the block before
            out[n - 16 :] = self.box_muller(self.uniform(16))
        return out.reshape(shape)

    @staticmethod
    def box_muller(u):
        u1, u2 = np.moveaxis(u.reshape(-1, 2, 8), 1, 0)
        radius = np.sqrt(f32(-2) * log(f32(1) - u1))
        sin, cos = sin_cos(f32(2 * math.pi) * u2)
        return np.stack([radius * cos, radius * sin], axis=1).ravel()

    def one_normal(self):
        if self.spare is not None:
            out, self.spare = self.spare, None
            return out
        u1, u2 = ((int(high) << 32 | int(low)) % 2**53 / 2**53 for high, low in self.raw(4).reshape(2, 2))
        radius = math.sqrt(-2.0 * math.log1p(-u2))
        self.spare = radius * math.sin(2 * math.pi * u1)
        return radius * math.cos(2 * math.pi * u1)


def bfloat16(x):
    """float32 numbers rounded to what bfloat16 holds, to even."""
    bits = np.ascontiguousarray(x, f32).view(np.uint32)
    return ((bits + 0x7FFF + ((bits >> 16) & 1)) & np.uint32(0xFFFF0000)).view(f32)
