// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

#include "base/result.h"

namespace vla {

/// Which kernels a device uses; each includes the ones before it: a machine with `amx` runs `avx512` too.
enum class Isa {
  ggml,         // no kernels of our own: plain ggml operations, the reference of every other row
  avx2,         // AVX2, FMA, F16C
  avx512,       // AVX-512 F, BW, DQ, VL
  avx512_bf16,  // AVX-512 BF16
  amx           // AMX tiles of bf16 with the system's leave to use them
};

/// The name that `--kernels` takes.
std::string isa_name(Isa isa);

/// Instructions for products of int8, which a machine of any Isa may have or lack.
bool has_avx_vnni();
bool has_avx512_vnni();
bool has_amx_int8();
/// The processor permutes with AVX-512 and multiplies with VNNI at the same time, as AMD's does; Intel's does one or
/// the other.
bool permutes_beside_vnni();

/// What this machine can run, `ggml` first and the best last.
const std::vector<Isa>& usable_isas();

/// Whether these kernels round what they multiply to bf16.
inline bool rounds_to_bf16(Isa isa) { return isa >= Isa::avx512_bf16; }

/// The same, or what takes its place where nothing may be rounded to bf16.
inline Isa without_rounding(Isa isa) { return rounds_to_bf16(isa) ? Isa::avx512 : isa; }

/// The kernels by name: of an Isa, or "float32" for the best that round nothing to bf16, or "bf16" for the best that
/// do. An empty name takes the best.
/// Errors: usage for an unknown name, device for one that the machine cannot run.
Result<Isa> choose_isa(const std::string& name);

}  // namespace vla
