// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// The AMX kernels for machines with AVX2.
#if defined(__x86_64__)
#include "support/amx_emulation.h"

#include "kernels/linear_amx.cpp"
#endif
