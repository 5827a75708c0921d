// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Attention by the products of AVX-512 BF16, for machines with AVX2.
#if defined(__x86_64__)
#include "support/avx512_bf16_emulation.h"

#include "kernels/attention_avx512_bf16.cpp"
#endif
