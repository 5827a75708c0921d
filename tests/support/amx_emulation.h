// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

/// The tiles of AMX in plain C++, as avx512_emulation.h does the vectors.
/// Source: Intel 64 and IA-32 Architectures Software Developer's Manual, volume 2, TDPBF16PS and its neighbours.
#include "support/avx512_bf16_emulation.h"

#include <doctest/doctest.h>

#include <cstddef>
#include <cstdint>

namespace vla::test::amx {

using bf16::flush, bf16::multiply_add;

struct Config {
  std::uint8_t palette, start_row, reserved[14];
  std::uint16_t bytes[16];
  std::uint8_t lines[16];
};
struct Tile {
  std::byte line[16][64];
};
/// What the processor keeps for a thread.
inline thread_local Config config;
inline thread_local Tile tiles[8];

inline int lines(int tile) { return config.lines[tile]; }
inline std::size_t bytes(int tile) { return config.bytes[tile]; }

inline void load_config(const void* p) {
  std::memcpy(&config, p, sizeof(config));
  REQUIRE(config.palette == 1);
  for (std::uint8_t zero : config.reserved) REQUIRE(zero == 0);
  for (int i = 0; i < 16; ++i) REQUIRE((i < 8 ? bytes(i) <= 64 && lines(i) <= 16 : bytes(i) == 0 && lines(i) == 0));
}
inline void release() { config = {}; }
inline void zero(int tile) {
  REQUIRE(config.palette == 1);
  tiles[tile] = {};
}
inline void load(int tile, const void* base, std::size_t stride) {
  zero(tile);
  for (int i = 0; i < lines(tile); ++i)
    std::memcpy(tiles[tile].line[i], static_cast<const std::byte*>(base) + static_cast<std::size_t>(i) * stride,
                bytes(tile));
}
inline void store(int tile, void* base, std::size_t stride) {
  REQUIRE(config.palette == 1);
  for (int i = 0; i < lines(tile); ++i)
    std::memcpy(static_cast<std::byte*>(base) + static_cast<std::size_t>(i) * stride, tiles[tile].line[i], bytes(tile));
}

/// c += a * b, where a line of b holds a pair of numbers for every column of c: even and odd numbers are summed apart.
VLA_UNWATCHED inline void multiply(int c, int a, int b) {
  const auto number = [](int tile, int line, int i) VLA_UNWATCHED {
    std::uint16_t bits;
    std::memcpy(&bits, tiles[tile].line[line] + 2 * i, sizeof(bits));
    return __builtin_bit_cast(float, std::uint32_t{bits} << 16);
  };
  REQUIRE(bytes(a) / 4 == static_cast<std::size_t>(lines(b)));
  REQUIRE((lines(a) == lines(c) && bytes(b) == bytes(c)));
  const int n_line = lines(c), n_column = static_cast<int>(bytes(c)) / 4, depth = lines(b);
  for (int m = 0; m < n_line; ++m)
    for (int n = 0; n < n_column; ++n) {
      float even = 0, odd = 0, sum;
      for (int k = 0; k < depth; ++k) {
        even = multiply_add(number(a, m, 2 * k), number(b, k, 2 * n), even);
        odd = multiply_add(number(a, m, 2 * k + 1), number(b, k, 2 * n + 1), odd);
      }
      std::memcpy(&sum, tiles[c].line[m] + 4 * n, sizeof(sum));
      sum = flush(flush(sum) + flush(even + odd));
      std::memcpy(tiles[c].line[m] + 4 * n, &sum, sizeof(sum));
    }
}

/// The same of bytes, four in a line of b for every column of c: signed in a, unsigned in b.
VLA_UNWATCHED inline void multiply_bytes(int c, int a, int b) {
  REQUIRE(bytes(a) / 4 == static_cast<std::size_t>(lines(b)));
  REQUIRE((lines(a) == lines(c) && bytes(b) == bytes(c)));
  const int n_line = lines(c), n_column = static_cast<int>(bytes(c)) / 4, depth = 4 * lines(b);
  for (int m = 0; m < n_line; ++m)
    for (int n = 0; n < n_column; ++n) {
      std::int32_t sum;
      std::memcpy(&sum, tiles[c].line[m] + 4 * n, sizeof(sum));
      for (int k = 0; k < depth; ++k)
        sum += static_cast<signed char>(tiles[a].line[m][k]) * static_cast<int>(tiles[b].line[k / 4][4 * n + k % 4]);
      std::memcpy(tiles[c].line[m] + 4 * n, &sum, sizeof(sum));
    }
}

}  // namespace vla::test::amx

#undef _tile_loadd
#undef _tile_stream_loadd
#undef _tile_stored
#undef _tile_zero
#undef _tile_dpbf16ps
#undef _tile_dpbsud
#define _tile_loadconfig vla::test::amx::load_config
#define _tile_release vla::test::amx::release
#define _tile_loadd vla::test::amx::load
#define _tile_stream_loadd vla::test::amx::load
#define _tile_stored vla::test::amx::store
#define _tile_zero vla::test::amx::zero
#define _tile_dpbf16ps vla::test::amx::multiply
#define _tile_dpbsud vla::test::amx::multiply_bytes

#define AmxSession EmulatedAmxSession
