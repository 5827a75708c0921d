// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// Loops of multiply-adds on registers (probe/peak_probes.cpp): 28 sums of products of zeros.
#include "kernels/machine_kernels.h"

namespace vla::kernels {
namespace {

// clang-format off
#define VLA_SUM_LOOP(multiply_add)                                                                              \
  if (n_round <= 0) return;                                                                                     \
  __asm__ volatile("movi v30.4s, #0\nmovi v31.4s, #0\n"                                                         \
                   "1:\n.irp sum, 0,1,2,3,4,5,6,7,8,9,10,11,12,13,14,15,16,17,18,19,20,21,22,23,24,25,26,27\n"  \
                   multiply_add "\n.endr\nsubs %0, %0, #1\nb.ne 1b"                                             \
                   : "+r"(n_round) : : "cc", "v0", "v1", "v2", "v3", "v4", "v5", "v6", "v7", "v8", "v9", "v10", \
                     "v11", "v12", "v13", "v14", "v15", "v16", "v17", "v18", "v19", "v20", "v21", "v22", "v23", \
                     "v24", "v25", "v26", "v27", "v28", "v29", "v30", "v31")
// clang-format on

void multiply_add_neon(long n_round) { VLA_SUM_LOOP("fmla v\\sum\\().4s, v30.4s, v31.4s"); }

[[gnu::target("arch=armv8.2-a+dotprod")]] void multiply_add_dotprod(long n_round) {
  VLA_SUM_LOOP("sdot v\\sum\\().4s, v30.16b, v31.16b");
}

[[gnu::target("arch=armv8.2-a+bf16")]] void multiply_add_bf16(long n_round) {
  VLA_SUM_LOOP("bfmmla v\\sum\\().4s, v30.8h, v31.8h");
}

[[gnu::target("arch=armv8.2-a+i8mm")]] void multiply_add_i8mm(long n_round) {
  VLA_SUM_LOOP("smmla v\\sum\\().4s, v30.16b, v31.16b");
}

#undef VLA_SUM_LOOP

}  // namespace

std::span<const PeakProbe> machine::peak_probes() {
  static const PeakProbe all[] = {
      {"neon f32", {Feature::neon}, Number::f32, 28 * 4 * 2, multiply_add_neon},
      {"dotprod int8", {Feature::dotprod}, Number::int8, 28 * 16 * 2, multiply_add_dotprod},
      {"neon bf16", {Feature::neon_bf16}, Number::bf16, 28 * 16 * 2, multiply_add_bf16},
      {"i8mm int8", {Feature::i8mm}, Number::int8, 28 * 32 * 2, multiply_add_i8mm},
  };
  return all;
}

}  // namespace vla::kernels
