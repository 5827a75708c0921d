// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/isa.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>

#if defined(__x86_64__)
#include <cpuid.h>
#include <sys/syscall.h>
#include <unistd.h>
#endif

namespace vla {
namespace {

#if defined(__x86_64__)

/// Tiles are 8 kB of registers that the kernel saves only for processes that request them.
bool may_use_tiles() {
  constexpr int kRequestPermission = 0x1023, kTileData = 18;  // ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA
  return syscall(SYS_arch_prctl, kRequestPermission, kTileData) == 0;
}

bool has_avx512_bf16() {
  unsigned a = 0, b = 0, c = 0, d = 0;
  constexpr unsigned kBf16 = 1U << 5;
  return __get_cpuid_count(7, 1, &a, &b, &c, &d) != 0 && (a & kBf16) != 0;
}

bool has_amx_bf16() {
  unsigned a = 0, b = 0, c = 0, d = 0;
  constexpr unsigned kTileBf16 = 1U << 22, kTile = 1U << 24;
  if (__get_cpuid_count(7, 0, &a, &b, &c, &d) == 0) return false;
  return (d & kTileBf16) != 0 && (d & kTile) != 0 && may_use_tiles();
}

/// Clang's __builtin_cpu_supports knows no "f16c". The registers are AVX's.
bool has_f16c() {
  unsigned a = 0, b = 0, c = 0, d = 0;
  constexpr unsigned kF16c = 1U << 29;
  return __get_cpuid(1, &a, &b, &c, &d) != 0 && (c & kF16c) != 0;
}

std::vector<Isa> detect() {
  std::vector<Isa> found = {Isa::ggml};
  __builtin_cpu_init();
  if (!__builtin_cpu_supports("avx2") || !__builtin_cpu_supports("fma") || !has_f16c()) return found;
  found.push_back(Isa::avx2);
  if (!__builtin_cpu_supports("avx512f") || !__builtin_cpu_supports("avx512bw") ||
      !__builtin_cpu_supports("avx512dq") || !__builtin_cpu_supports("avx512vl"))
    return found;
  found.push_back(Isa::avx512);
  if (!has_avx512_bf16()) return found;
  found.push_back(Isa::avx512_bf16);
  if (has_amx_bf16()) found.push_back(Isa::amx);
  return found;
}

#else

std::vector<Isa> detect() { return {Isa::ggml}; }

#endif

constexpr Isa kAll[] = {Isa::ggml, Isa::avx2, Isa::avx512, Isa::avx512_bf16, Isa::amx};

}  // namespace

#if defined(__x86_64__)
bool has_avx_vnni() {
  unsigned a = 0, b = 0, c = 0, d = 0;
  constexpr unsigned kAvxVnni = 1U << 4;
  return __get_cpuid_count(7, 1, &a, &b, &c, &d) != 0 && (a & kAvxVnni) != 0;
}
bool has_avx512_vnni() { return __builtin_cpu_supports("avx512vnni") != 0; }
bool permutes_beside_vnni() { return has_avx512_vnni() && __builtin_cpu_is("amd") != 0; }
bool has_amx_int8() {
  unsigned a = 0, b = 0, c = 0, d = 0;
  constexpr unsigned kTileInt8 = 1U << 25;
  return __get_cpuid_count(7, 0, &a, &b, &c, &d) != 0 && (d & kTileInt8) != 0;
}
#else
bool has_avx_vnni() { return false; }
bool has_avx512_vnni() { return false; }
bool permutes_beside_vnni() { return false; }
bool has_amx_int8() { return false; }
#endif

std::string isa_name(Isa isa) {
  switch (isa) {
    case Isa::avx2:
      return "avx2";
    case Isa::avx512:
      return "avx512";
    case Isa::avx512_bf16:
      return "avx512_bf16";
    case Isa::amx:
      return "amx";
    case Isa::ggml:
      break;
  }
  return "ggml";
}

const std::vector<Isa>& usable_isas() {
  static const std::vector<Isa> usable = detect();
  return usable;
}

Result<Isa> choose_isa(const std::string& name) {
  const std::vector<Isa>& usable = usable_isas();
  if (name.empty()) return usable.back();
  if (name == "float32") return without_rounding(usable.back());
  if (name == "bf16" && rounds_to_bf16(usable.back())) return usable.back();
  const auto is_named = [&](Isa isa) { return isa_name(isa) == name; };
  const auto found = std::find_if(usable.begin(), usable.end(), is_named);
  if (found != usable.end()) return *found;
  if (name != "bf16" && std::none_of(std::begin(kAll), std::end(kAll), is_named))
    return Error{Code::usage, "kernels", "ggml, avx2, avx512, avx512_bf16, amx, float32, bf16 or int8", name};
  std::vector<std::string> names;
  for (Isa isa : usable) names.push_back(isa_name(isa));
  return Error{Code::device, "kernels", fmt::format("what this machine can run: {}", fmt::join(names, ", ")), name,
               "leave the choice to the program"};
}

}  // namespace vla
