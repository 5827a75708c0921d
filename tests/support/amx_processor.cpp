// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// A processor with AMX wherever there is AVX2, for a program of tests that emulates the instructions. It has all that a
// kernel of the tests is compiled for: nothing of AVX-VNNI, nor of the kernel that looks sums up, which is all
// assembler.
#include "kernels/kernel_set.h"

namespace vla {

Features detect_features() {
  if (!__builtin_cpu_supports("avx2")) return {Feature::baseline};
  return kernel_set::amx.uses.with(Feature::baseline).without({Feature::avx_vnni, Feature::permutes_beside_vnni});
}

}  // namespace vla
