// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <immintrin.h>

#include <cstdint>

#include "kernels/x86/vec_avx512.h"

/// Rounding to bf16 by the instructions of AVX-512 BF16: to the nearest, ties to even, as PyTorch rounds; a NaN stays
/// one. What bf16 holds only as a subnormal number becomes zero, as it does in their products. Only files that are
/// compiled for these instructions may include this.
namespace vla::kernels {

/// Two vectors.
VLA_INLINE void store_bf16(std::uint16_t* to, Avx512::Float a, Avx512::Float b) {
  const __m512bh numbers = _mm512_cvtne2ps_pbh(b, a);
  std::memcpy(to, &numbers, sizeof(numbers));
}

/// A vector, or the `left` elements of it that there are.
VLA_INLINE void store_bf16(std::uint16_t* to, Avx512::Float x, std::int64_t left) {
  const __m256bh numbers = _mm512_cvtneps_pbh(x);
  std::memcpy(to, &numbers, left >= 16 ? sizeof(numbers) : static_cast<std::size_t>(left) * sizeof(*to));
}

}  // namespace vla::kernels
