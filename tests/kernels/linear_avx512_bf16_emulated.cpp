// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// The kernel of AVX-512 BF16 for machines with AVX2.
#if defined(__x86_64__)
#include "support/avx512_bf16_emulation.h"

#define asm(...) static_cast<void>(0)  // a hint that names a register of 64 bytes

#include "kernels/linear_avx512_bf16.cpp"
#endif
