// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <immintrin.h>

#include <cstdint>

#include "kernels/x86/vec_avx512.h"

/// Rounds to bf16 with AVX-512 BF16: to nearest, ties to even, as PyTorch does; NaN stays NaN. Values that are
/// subnormal in bf16 become zero, as in products. Include this only in files compiled for these instructions.
namespace vla::kernels {

/// Rounds and stores two vectors.
VLA_INLINE void store_bf16(std::uint16_t* to, Avx512::Float a, Avx512::Float b) {
  const __m512bh numbers = _mm512_cvtne2ps_pbh(b, a);
  std::memcpy(to, &numbers, sizeof(numbers));
}

/// Rounds and stores a vector, or its first `left` elements.
VLA_INLINE void store_bf16(std::uint16_t* to, Avx512::Float x, std::int64_t left) {
  const __m256bh numbers = _mm512_cvtneps_pbh(x);
  std::memcpy(to, &numbers, left >= 16 ? sizeof(numbers) : static_cast<std::size_t>(left) * sizeof(*to));
}

}  // namespace vla::kernels
