// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/linear_kernel.h"
#include "kernels/quantized.h"

/// How a ternary matrix, or one of int8, lies in memory for the kernels, from load on.
///
/// A *strip* holds 16 columns of the product (rows of W) over the whole depth (d_in). Kernels multiply a line of 64
/// bytes at a time, four consecutive numbers of every column, as instructions that sum products of four bytes take
/// them. Numbers may be stored with an offset, which comes off the sums again. Zeros fill strips up to four, and the
/// depth up to 64, where x has zeros.
namespace vla::kernels {

struct Int8Panels {
  static constexpr std::int64_t kColumns = 16, kGroup = 16, kLine = 64;
};

/// Lines as they are multiplied: -128 to 127, and 128 more where instructions take weights without a sign, as those of
/// x86-64 do.
struct BytePanels : Int8Panels {
#if defined(__x86_64__)
  using Number = std::uint8_t;
  static constexpr int kOffset = 128;
#else
  using Number = std::int8_t;
  static constexpr int kOffset = 0;
#endif
  /// A scale for each column.
  static constexpr bool kManyScales = true;

  static constexpr VLA_INLINE std::int64_t strip_size(std::int64_t d_in) { return quantized_depth(d_in) * kColumns; }

  // A LinearKernel's functions.
  static std::size_t packed_size(const MatrixDesc& desc);
  static void pack(const MatrixDesc& desc, const std::byte* stored, std::byte* packed);
};

/// Two bits for a number, -1 to 1 plus 1: byte 4 n + i of a line has numbers i, 4 + i, 8 + i and 12 + i of column n,
/// the first in its lowest bits. So what is left of the line after a shift by 2 s and a mask is one as it is
/// multiplied.
struct TernaryPanels : Int8Panels {
  static constexpr int kOffset = 1;
  static constexpr bool kManyScales = false;

  static constexpr VLA_INLINE std::int64_t strip_size(std::int64_t d_in) {
    return quantized_depth(d_in) / kGroup * kLine;
  }

  // A LinearKernel's functions.
  static std::size_t packed_size(const MatrixDesc& desc);
  static void pack(const MatrixDesc& desc, const std::byte* stored, std::byte* packed);

  /// A byte for each number of `n_strip` strips over a depth: lines of 64 bytes with four numbers of 16 columns, of one
  /// strip after the other, then the next four numbers.
  template <int kStrips>
  static VLA_INLINE void expand(const std::byte* strips, std::int64_t strip, std::int64_t depth, std::byte* to) {
    constexpr std::uint64_t kMask = 0x0303030303030303;
    for (std::int64_t k = 0; k < depth; k += kGroup, strips += kLine, to += 4 * kStrips * kLine)
      for (int i = 0; i < kStrips; ++i) {
        std::uint64_t codes[8];
        std::memcpy(codes, strips + i * strip, sizeof(codes));
        for (int s = 0; s < 4; ++s) {
          std::uint64_t line[8];
          for (int word = 0; word < 8; ++word) line[word] = codes[word] >> 2 * s & kMask;
          std::memcpy(to + (s * kStrips + i) * kLine, line, sizeof(line));
        }
      }
  }
};

}  // namespace vla::kernels
