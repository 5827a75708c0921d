// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "base/cpu.h"

#if defined(__x86_64__)
#include <cpuid.h>
#include <sys/syscall.h>
#include <unistd.h>
#elif defined(__aarch64__)
#include <sys/auxv.h>
#endif

namespace vla {

#if defined(__x86_64__)
namespace {

/// AMX tiles are 8 kB of registers. The operating system saves them only for processes that ask for them.
bool may_use_tiles() {
  constexpr int kRequestPermission = 0x1023, kTileData = 18;  // ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA
  return syscall(SYS_arch_prctl, kRequestPermission, kTileData) == 0;
}

struct Registers {
  unsigned a = 0, b = 0, c = 0, d = 0;

  /// All zeros where the processor has no such leaf.
  Registers(unsigned leaf, unsigned part) { __get_cpuid_count(leaf, part, &a, &b, &c, &d); }
};

bool is_set(unsigned bits, int i) { return (bits >> i & 1U) != 0; }

}  // namespace

/// Source: Intel 64 and IA-32 Architectures Software Developer's Manual, volume 2, CPUID leaves 1 and 7.
Features detect_features() {
  __builtin_cpu_init();  // also checks by XGETBV which vector registers the operating system saves
  Features found = {Feature::baseline};
  const Registers leaf1(1, 0), leaf7(7, 0), more(7, 1);
  if (!__builtin_cpu_supports("avx2") || !__builtin_cpu_supports("fma") || !is_set(leaf1.c, 29))  // F16C
    return found;
  const auto add = [&found](bool has, Feature feature) {
    if (has) found = found.with(feature);
  };
  add(true, Feature::avx2);
  add(is_set(more.a, 4), Feature::avx_vnni);
  if (!__builtin_cpu_supports("avx512f") || !__builtin_cpu_supports("avx512bw") ||
      !__builtin_cpu_supports("avx512dq") || !__builtin_cpu_supports("avx512vl"))
    return found;
  add(true, Feature::avx512);
  add(__builtin_cpu_supports("avx512vnni") != 0, Feature::avx512_vnni);
  add(found.has(Feature::avx512_vnni) && __builtin_cpu_is("amd") != 0, Feature::permutes_beside_vnni);
  if (!is_set(more.a, 5)) return found;
  add(true, Feature::avx512_bf16);
  const bool has_tiles = is_set(leaf7.d, 22) && is_set(leaf7.d, 24) && may_use_tiles();
  add(has_tiles, Feature::amx_bf16);
  add(has_tiles && is_set(leaf7.d, 25), Feature::amx_int8);
  return found;
}

#elif defined(__aarch64__)

/// Source: Linux, Documentation/arch/arm64/elf_hwcaps.rst.
Features detect_features() {
  constexpr unsigned long kAsimd = 1UL << 1, kAsimdDp = 1UL << 20, kI8mm = 1UL << 13, kBf16 = 1UL << 14;
  const unsigned long has = getauxval(AT_HWCAP), has_too = getauxval(AT_HWCAP2);
  Features found = {Feature::baseline};
  if ((has & kAsimd) == 0) return found;
  found = found.with(Feature::neon);
  if ((has_too & kBf16) != 0) found = found.with(Feature::neon_bf16);
  if ((has & kAsimdDp) == 0) return found;
  found = found.with(Feature::dotprod);
  if ((has_too & kI8mm) != 0) found = found.with(Feature::i8mm);
  return found;
}

#else

Features detect_features() { return {Feature::baseline}; }

#endif

}  // namespace vla
