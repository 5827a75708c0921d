// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/arm/vec_neon.h"

namespace vla::kernels {

/// sums += four columns * element k of each of six rows, as one block of assembly. With intrinsics, or with a separate
/// load, GCC 12 moves and spills sums: 24 sums, six rows and the columns leave one register. `load` reads the columns
/// at %14 into register %6 as floats; %15 is zero.
// clang-format off
#define VLA_NEON_MULTIPLY_ADD(load, from)                                                                              \
  typedef std::uint8_t Bytes __attribute__((vector_size(16), aligned(1)));                                             \
  Neon::Float columns;                                                                                                 \
  asm(load                                                                                                             \
      "\n\tfmla %0.4s, %6.4s, %7.s[%13]\n\tfmla %1.4s, %6.4s, %8.s[%13]\n\tfmla %2.4s, %6.4s, %9.s[%13]"               \
      "\n\tfmla %3.4s, %6.4s, %10.s[%13]\n\tfmla %4.4s, %6.4s, %11.s[%13]\n\tfmla %5.4s, %6.4s, %12.s[%13]"            \
      : "+w"(sums[0]), "+w"(sums[1]), "+w"(sums[2]), "+w"(sums[3]), "+w"(sums[4]), "+w"(sums[5]), "=&w"(columns)       \
      : "w"(rows[0]), "w"(rows[1]), "w"(rows[2]), "w"(rows[3]), "w"(rows[4]), "w"(rows[5]), "n"(k),                    \
        "m"(*reinterpret_cast<const Bytes*>(from)), "w"(zero))
// clang-format on

template <int k>
VLA_INLINE void multiply_add_floats(const void* from, const Neon::Float (&rows)[6], Neon::Float zero,
                                    Neon::Float (&sums)[6]) {
  VLA_NEON_MULTIPLY_ADD("ldr %q6, %14", from);
}
template <int k>
VLA_INLINE void multiply_add_halves(const void* from, const Neon::Float (&rows)[6], Neon::Float zero,
                                    Neon::Float (&sums)[6]) {
  VLA_NEON_MULTIPLY_ADD("ldr %d6, %14\n\tfcvtl %6.4s, %6.4h", from);
}
/// The same for the first or second element of pairs of bf16.
template <int k>
VLA_INLINE void multiply_add_firsts(const void* from, const Neon::Float (&rows)[6], Neon::Float zero,
                                    Neon::Float (&sums)[6]) {
  VLA_NEON_MULTIPLY_ADD("ldr %q6, %14\n\ttrn1 %6.8h, %15.8h, %6.8h", from);
}
template <int k>
VLA_INLINE void multiply_add_seconds(const void* from, const Neon::Float (&rows)[6], Neon::Float zero,
                                     Neon::Float (&sums)[6]) {
  VLA_NEON_MULTIPLY_ADD("ldr %q6, %14\n\ttrn2 %6.8h, %15.8h, %6.8h", from);
}
#undef VLA_NEON_MULTIPLY_ADD

}  // namespace vla::kernels
