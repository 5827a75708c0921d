// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <arm_neon.h>

#include <cstring>

#include "kernels/sizes.h"

/// Tiles for BFMMLA and SMMLA. An instruction multiplies two rows of x by two columns of a panel, eight bytes of each:
/// four bf16 or eight codes. x is stored as pairs of rows and a panel as pairs of columns, alternating eight bytes of
/// each. A panel has 16 columns, so a step of eight bytes is 128 bytes. Include this only in files compiled for these
/// instructions.
namespace vla::kernels {

/// Bytes of a row or column per instruction.
constexpr std::int64_t kMmlaStep = 8;
constexpr int kMmlaRows = 6, kMmlaColumns = 16;

/// A step of three pairs of rows by eight pairs of columns: sums in registers 8 to 31, rows in 0 to 2, columns in 3 and
/// 4. The loop is one block of assembly, because GCC 12 otherwise moves a third of the sums between registers. `also`:
/// extra instructions in each step.
// clang-format off
#define VLA_MMLA_SIX(op, type, s0, s1, s2, s3, s4, s5, n)                                                              \
  "ldp q3, q4, [%[b], #32 * " #n "]\n\t"                                                                               \
  op " v" #s0 ".4s, v0." type ", v3." type "\n\t" op " v" #s1 ".4s, v1." type ", v3." type "\n\t"                      \
  op " v" #s2 ".4s, v2." type ", v3." type "\n\t" op " v" #s3 ".4s, v0." type ", v4." type "\n\t"                      \
  op " v" #s4 ".4s, v1." type ", v4." type "\n\t" op " v" #s5 ".4s, v2." type ", v4." type "\n\t"
#define VLA_MMLA_LOOP(op, type, also)                                                                                  \
  asm volatile(                                                                                                        \
      ".irp n, 8,9,10,11,12,13,14,15,16,17,18,19,20,21,22,23,24,25,26,27,28,29,30,31\n\tmovi v\\n\\().4s, #0\n.endr\n" \
      "1:\n\tldr q0, [%[a0]], #16\n\tldr q1, [%[a1]], #16\n\tldr q2, [%[a2]], #16\n\t" also                            \
      VLA_MMLA_SIX(op, type, 8, 9, 10, 11, 12, 13, 0) VLA_MMLA_SIX(op, type, 14, 15, 16, 17, 18, 19, 1)                \
      VLA_MMLA_SIX(op, type, 20, 21, 22, 23, 24, 25, 2) VLA_MMLA_SIX(op, type, 26, 27, 28, 29, 30, 31, 3)              \
      "add %[b], %[b], #128\n\tsubs %[n], %[n], #1\n\tb.gt 1b\n\t"                                                     \
      "stp q8, q9, [%[s]]\n\tstp q10, q11, [%[s], #32]\n\tstp q12, q13, [%[s], #64]\n\tstp q14, q15, [%[s], #96]\n\t"  \
      "stp q16, q17, [%[s], #128]\n\tstp q18, q19, [%[s], #160]\n\tstp q20, q21, [%[s], #192]\n\t"                     \
      "stp q22, q23, [%[s], #224]\n\tstp q24, q25, [%[s], #256]\n\tstp q26, q27, [%[s], #288]\n\t"                     \
      "stp q28, q29, [%[s], #320]\n\tstp q30, q31, [%[s], #352]"                                                       \
      : [a0] "+r"(a0), [a1] "+r"(a1), [a2] "+r"(a2), [b] "+r"(panel), [n] "+r"(n_step), [ahead] "+r"(ahead)            \
      : [s] "r"(sums), [skip] "r"(skip)                                                                                \
      : "cc", "memory", "v0", "v1", "v2", "v3", "v4", "v8", "v9", "v10", "v11", "v12", "v13", "v14", "v15", "v16",     \
        "v17", "v18", "v19", "v20", "v21", "v22", "v23", "v24", "v25", "v26", "v27", "v28", "v29", "v30", "v31")
// clang-format on

/// Where to prefetch: an address, and the bytes to advance per step.
struct MmlaAhead {
  const std::byte* from;
  std::int64_t skip;
};

/// c [kMmlaColumns] x 2 kPairs rows = products, or += if `add`, over n_step steps. `stride`: bytes between pairs of
/// rows. `Op` has Sum, Vector (of sums), multiply(sums, rows, columns), and three_pairs(), which is VLA_MMLA_LOOP.
template <class Op, int kPairs>
VLA_INLINE void multiply_pairs(const std::byte* x, std::int64_t stride, const std::byte* panel, std::int64_t n_step,
                               typename Op::Sum* c, bool add, MmlaAhead ahead) {
  using Vector = typename Op::Vector;
  Vector sums[8][kPairs] = {};
  if constexpr (2 * kPairs == kMmlaRows) {
    Op::three_pairs(x, x + stride, x + 2 * stride, panel, n_step, ahead.from, ahead.skip, &sums[0][0]);
  } else {
    for (std::int64_t i = 0; i < n_step; ++i, x += 16, panel += 128, ahead.from += ahead.skip) {
      __builtin_prefetch(ahead.from, 0, 2);
      int8x16_t rows[kPairs];
      for (int r = 0; r < kPairs; ++r) std::memcpy(&rows[r], x + r * stride, sizeof(rows[r]));
#pragma GCC unroll 8
      for (int n = 0; n < 8; ++n) {
        int8x16_t columns;
        std::memcpy(&columns, panel + 16 * n, sizeof(columns));
#pragma GCC unroll 3
        for (int r = 0; r < kPairs; ++r) sums[n][r] = Op::multiply(sums[n][r], rows[r], columns);
      }
    }
  }
  // Splits sums of two rows by two columns into rows.
#pragma GCC unroll 3
  for (int r = 0; r < kPairs; ++r)
#pragma GCC unroll 8
    for (int n = 0; n < 8; n += 2) {
      Vector rows[2] = {__builtin_shufflevector(sums[n][r], sums[n + 1][r], 0, 1, 4, 5),
                        __builtin_shufflevector(sums[n][r], sums[n + 1][r], 2, 3, 6, 7)};
      for (int i = 0; i < 2; ++i) {
        typename Op::Sum* place = c + (2 * r + i) * kMmlaColumns + 2 * n;
        Vector before;
        std::memcpy(&before, place, sizeof(before));
        if (add) rows[i] += before;
        std::memcpy(place, &rows[i], sizeof(rows[i]));
      }
    }
}

/// The same for n_row <= kMmlaRows; an odd number is rounded up.
template <class Op>
VLA_INLINE void multiply_mmla(int n_row, const std::byte* x, std::int64_t stride, const std::byte* panel,
                              std::int64_t n_step, typename Op::Sum* c, bool add, MmlaAhead ahead) {
  if (n_row > 4)
    multiply_pairs<Op, 3>(x, stride, panel, n_step, c, add, ahead);
  else if (n_row > 2)
    multiply_pairs<Op, 2>(x, stride, panel, n_step, c, add, ahead);
  else
    multiply_pairs<Op, 1>(x, stride, panel, n_step, c, add, ahead);
}

}  // namespace vla::kernels
