// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/attention_tile.h"
#include "kernels/x86/rounding_avx512.h"

namespace vla::kernels {
namespace {

struct Avx512Pairs {
  using Float = Avx512::Float;
  static VLA_INLINE void store(std::uint16_t* to, Float a, Float b) { store_bf16(to, a, b); }
  static VLA_INLINE Float add(Float sum, Float a, Float b) {
    return _mm512_dpbf16_ps(sum, std::bit_cast<__m512bh>(a), std::bit_cast<__m512bh>(b));
  }
};

using Attention = AttentionTile<VectorPairProducts<Avx512, 12, Avx512Pairs>>;

}  // namespace

extern const AttentionKernel kAttentionAvx512Bf16;
const AttentionKernel kAttentionAvx512Bf16 = Attention::kernel();

}  // namespace vla::kernels
