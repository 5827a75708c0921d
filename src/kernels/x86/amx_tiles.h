// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/x86/rounding_avx512.h"

/// Common parts of all products on AMX tiles. Include this only in files compiled for AMX.
namespace vla::kernels {

/// Configures all eight tiles as 16 lines of 64 bytes. The configuration is constant memory, because GCC's intrinsic
/// claims to read only eight bytes, so stores to the rest of a variable could be removed. Source: Intel Architecture
/// Instruction Set Extensions, chapter on AMX, LDTILECFG.
struct alignas(64) TileConfig {
  std::uint8_t palette = 1, start_row = 0, reserved[14] = {};
  std::uint16_t bytes[16] = {64, 64, 64, 64, 64, 64, 64, 64};
  std::uint8_t lines[16] = {16, 16, 16, 16, 16, 16, 16, 16};
};
inline constexpr TileConfig kTileConfig;

/// Configures this thread's tiles and releases them at the end.
struct AmxSession {
  VLA_INLINE AmxSession() { _tile_loadconfig(&kTileConfig); }
  VLA_INLINE ~AmxSession() { _tile_release(); }
};

/// How products on tiles store y as bf16.
struct AmxRounding {
  using V = Avx512;
  static VLA_INLINE void store_rounded(std::uint16_t* to, V::Float x, std::int64_t left) { store_bf16(to, x, left); }
  static VLA_INLINE void store_rounded(std::uint16_t* to, V::Float x, V::Float y) { store_bf16(to, x, y); }
};

/// Call it before tiles are loaded. GCC's intrinsic does not say that it reads memory, so the compiler could move
/// earlier stores past it.
VLA_INLINE void before_tile_loads() { asm volatile("" ::: "memory"); }

/// After about 2,300 cycles without 512-bit arithmetic the processor powers that unit down, and the next tile store
/// waits for about 950 cycles (measured on Granite Rapids). A loop of tile instructions that may take so long adds one
/// vector in each round to keep it powered.
class KeepVectorUnitPowered {
 public:
  VLA_INLINE ~KeepVectorUnitPowered() { asm volatile("" ::"m"(sum_)); }  // so that the compiler does not drop the sum
  VLA_INLINE void keep() { sum_ += 1.0f; }

 private:
  Avx512::Float sum_ = {};
};

}  // namespace vla::kernels
