// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// The AMX kernels of int8 products for machines with AVX2.
#if defined(__x86_64__)
#include "support/amx_emulation.h"

#include "kernels/int8_amx.cpp"
#endif
