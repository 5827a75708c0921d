// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

/// Makes isa.cpp see a processor with AMX wherever there is AVX2, for tests that emulate the instructions.
#include <cpuid.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <atomic>  // which has system calls of its own

#define __builtin_cpu_supports(feature) __builtin_cpu_supports("avx2")
// Of no maker: the kernel that looks sums up beside multiplying, for AMD, is all assembler and not emulated.
#define __builtin_cpu_is(maker) 0
// Bit 5 of part 1 is AVX-512 BF16; AVX-VNNI is not emulated.
#define __get_cpuid_count(leaf, part, a, b, c, d) (*(a) = 1U << 5, *(b) = *(c) = *(d) = ~0U, 1)
#define syscall(number, request, feature) (0 * (request) * (feature))
