// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>

#include "kernels/cpu_kernels.h"

namespace vla::test {

/// For doctest's skip decorator: a test of instructions that this machine lacks is counted as skipped under its name.
inline bool lacks(Isa isa) { return std::find(usable_isas().begin(), usable_isas().end(), isa) == usable_isas().end(); }

}  // namespace vla::test

/// The same test for every instruction set, and for the portable instance of the same templates.
#define VLA_KERNEL_TEST(sentence, check)                                              \
  TEST_CASE("portable: " sentence) { check(vla::kernels::portable_kernels()); }       \
  TEST_CASE("avx2: " sentence* doctest::skip(vla::test::lacks(vla::Isa::avx2))) {     \
    check(*vla::kernels::cpu_kernels(vla::Isa::avx2));                                \
  }                                                                                   \
  TEST_CASE("avx512: " sentence* doctest::skip(vla::test::lacks(vla::Isa::avx512))) { \
    check(*vla::kernels::cpu_kernels(vla::Isa::avx512));                              \
  }
