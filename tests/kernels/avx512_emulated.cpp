// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// The AVX-512 kernels for machines with AVX2.
#if defined(__x86_64__)
#include "support/avx512_emulation.h"

#define asm(...) static_cast<void>(0)  // a hint that names a register of 64 bytes

#include "kernels/cpu_kernels_avx512.cpp"
#include "kernels/linear_avx512.cpp"
#endif
