// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>

#include "kernels/cpu_kernels.h"
#include "kernels/linear_kernel.h"

namespace vla::test {

/// For doctest's skip decorator: a test of instructions that this machine lacks is counted as skipped under its name.
inline bool lacks(const KernelSet& set) {
  return std::find(usable_kernels().begin(), usable_kernels().end(), set) == usable_kernels().end();
}

}  // namespace vla::test

#if defined(__x86_64__)
namespace vla::kernels {
/// The sources of avx512, avx512_bf16 and amx with their instructions emulated, for machines that have AVX2
/// (avx512_emulation.h).
extern const CpuKernels kEmulatedAvx512Kernels;
extern const AttentionKernel kEmulatedAttentionAvx512Bf16, kEmulatedAttentionAmx;
extern const LinearKernel kEmulatedLinearAvx512, kEmulatedLinearAvx512Bf16, kEmulatedLinearAmx;
extern const LinearKernel kEmulatedTernaryAvx512, kEmulatedInt4Avx512, kEmulatedInt8Avx512;
extern const LinearKernel kEmulatedTernaryAmx, kEmulatedInt4Amx, kEmulatedInt8Amx;
}  // namespace vla::kernels

#define VLA_EMULATED_TEST(isa, sentence, ...) \
  TEST_CASE(isa " (emulated): " sentence* doctest::skip(vla::test::lacks(vla::kernel_set::avx2))) { __VA_ARGS__; }
#else
#define VLA_EMULATED_TEST(isa, sentence, ...)
#endif

/// The same test for the portable kernels and for every instruction set.
#define VLA_KERNEL_TEST(sentence, check)                                                                  \
  TEST_CASE("portable: " sentence) { check(*vla::kernels::cpu_kernels(vla::kernel_set::portable.uses)); } \
  TEST_CASE("neon: " sentence* doctest::skip(vla::test::lacks(vla::kernel_set::neon))) {                  \
    check(*vla::kernels::cpu_kernels(vla::kernel_set::neon.uses));                                        \
  }                                                                                                       \
  TEST_CASE("avx2: " sentence* doctest::skip(vla::test::lacks(vla::kernel_set::avx2))) {                  \
    check(*vla::kernels::cpu_kernels(vla::kernel_set::avx2.uses));                                        \
  }                                                                                                       \
  VLA_EMULATED_TEST("avx512", sentence, check(vla::kernels::kEmulatedAvx512Kernels))                      \
  TEST_CASE("avx512: " sentence* doctest::skip(vla::test::lacks(vla::kernel_set::avx512))) {              \
    check(*vla::kernels::cpu_kernels(vla::kernel_set::avx512.uses));                                      \
  }
