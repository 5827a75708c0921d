// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <bit>
#include <cstring>

#include "kernels/linear_kernel.h"
#include "kernels/quantized.h"

/// Memory layout of a packed ternary, int4 or int8 matrix.
///
/// A *strip* holds 16 columns of the product (rows of W) over the whole depth (d_in). Kernels multiply one line of 64
/// bytes at a time: four consecutive elements of every column, as instructions that sum four byte products take them.
/// Elements may be stored with an offset, which is subtracted from the sums. The number of strips is padded to a
/// multiple of four and the depth to a multiple of 64, where x has zeros too.
namespace vla::kernels {

template <class Element, std::size_t kBytes>
struct VectorOf {
  typedef Element Type __attribute__((vector_size(kBytes)));
};

struct Int8Panels {
  static constexpr std::int64_t kColumns = 16, kGroup = 16, kLine = 64;
};

/// Lines as instructions multiply them: -128 to 127, plus 128 where instructions take unsigned weights, as on x86-64.
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

  template <int kStrips>
  struct Strips;

  // Functions of a LinearKernel.
  static std::size_t packed_size(const MatrixDesc& desc);
  static void pack(const MatrixDesc& desc, const std::byte* stored, std::byte* packed);
};

/// How a tile reads the elements of a panel of kStrips, with their offset. load(k, s, i, byte) returns a vector,
/// starting at a byte, of the line with elements k + 4 s to k + 4 s + 3 of strip i. k is a multiple of 16 and all
/// elements are in one block of 64. BytePanels stores lines as they are multiplied.
template <int kStrips>
struct BytePanels::Strips {
  const std::byte* strips;
  std::int64_t strip;  // stride in bytes

  /// Starts at element k of the depth.
  Strips(const std::byte* all, std::int64_t d_in, std::int64_t k)
      : strips(all + strip_size(k)), strip(strip_size(d_in)) {}

  template <class Vector>
  VLA_INLINE Vector load(std::int64_t k, int s, int i, int byte) const {
    Vector numbers;
    std::memcpy(&numbers, strips + i * strip + (k + 4 * s) * 16 + byte, sizeof(numbers));
    return numbers;
  }
  VLA_INLINE void fetch(std::int64_t /*k*/, int /*s*/, int /*i*/) const {}
};

/// Two bits per element, value + 1: byte 4 n + i of a line has elements i, 4 + i, 8 + i and 12 + i of column n, the
/// first in its lowest bits. A shift by 2 s and a mask therefore gives a line as it is multiplied.
struct TernaryPanels : Int8Panels {
  static constexpr int kOffset = 1;
  static constexpr bool kManyScales = false;

  static constexpr VLA_INLINE std::int64_t strip_size(std::int64_t d_in) {
    return quantized_depth(d_in) / kGroup * kLine;
  }

  // Functions of a LinearKernel.
  static std::size_t packed_size(const MatrixDesc& desc);
  static void pack(const MatrixDesc& desc, const std::byte* stored, std::byte* packed);

  template <int kStrips>
  struct Strips;
};

template <int kStrips>
struct TernaryPanels::Strips {
  const std::byte* strips;
  std::int64_t strip;

  Strips(const std::byte* all, std::int64_t d_in, std::int64_t k)
      : strips(all + strip_size(k)), strip(strip_size(d_in)) {}

  template <class Vector>
  VLA_INLINE Vector load(std::int64_t k, int s, int i, int byte) const {
    typedef std::uint64_t Words __attribute__((vector_size(sizeof(Vector))));
    Words words;
    std::memcpy(&words, strips + i * strip + k * 4 + s / 4 * kLine + byte, sizeof(words));
    return std::bit_cast<Vector>((words >> s % 4 * 2) & 0x0303030303030303U);
  }
  VLA_INLINE void fetch(std::int64_t /*k*/, int /*s*/, int /*i*/) const {}
};

/// Codes of four bits and a step for each 64 elements of a column (Int4Block), decoded to the elements of BytePanels.
/// Byte 4 n + i of a line has codes i and 4 + i of column n. After the lines of a strip come its steps, 16 for each 64
/// of the depth.
struct Int4Panels : Int8Panels {
  static constexpr int kOffset = BytePanels::kOffset;
  static constexpr bool kManyScales = true;

  static constexpr VLA_INLINE std::int64_t lines_size(std::int64_t d_in) {
    return quantized_depth(d_in) / 2 * kColumns;
  }
  static constexpr VLA_INLINE std::int64_t strip_size(std::int64_t d_in) {
    return lines_size(d_in) + quantized_depth(d_in) / Int4Block::kElements * kColumns;
  }

  // Functions of a LinearKernel.
  static std::size_t packed_size(const MatrixDesc& desc);
  static void pack(const MatrixDesc& desc, const std::byte* stored, std::byte* packed);

  template <int kStrips>
  struct Strips;
};

/// The same for a tile that multiplies codes and then a block's sum by the block's step: load returns codes, 1 to 15.
struct Int4Codes : Int4Panels {
  template <int kStrips>
  struct Strips;
};

template <int kStrips>
struct Int4Codes::Strips {
  const std::byte *lines, *steps;
  std::int64_t strip;

  Strips(const std::byte* all, std::int64_t d_in, std::int64_t k)
      : lines(all + lines_size(k)),
        steps(all + lines_size(d_in) + k / Int4Block::kElements * kColumns),
        strip(strip_size(d_in)) {}

  template <class Vector>
  VLA_INLINE Vector load(std::int64_t k, int s, int i, int byte) const {
    using Pairs = typename VectorOf<std::uint16_t, sizeof(Vector)>::Type;
    Pairs codes;
    std::memcpy(&codes, lines + i * strip + k * 8 + s / 2 * kLine + byte, sizeof(codes));
    return std::bit_cast<Vector>((codes >> s % 2 * 4) & 0x0f0f);
  }
  /// The step of each column, as two equal numbers of 16 bits.
  template <class Vector>
  VLA_INLINE Vector step(std::int64_t k, int i, int byte) const {
    using Columns = typename VectorOf<std::uint8_t, sizeof(Vector) / 4>::Type;
    using Twos = typename VectorOf<std::uint16_t, sizeof(Vector) / 2>::Type;
    using Fours = typename VectorOf<std::uint32_t, sizeof(Vector)>::Type;
    Columns columns;
    std::memcpy(&columns, steps + i * strip + k / Int4Block::kElements * kColumns + byte / 4, sizeof(columns));
    // In two steps, because GCC 12 would widen bytes to 32 bits one by one.
    const Fours step = __builtin_convertvector(__builtin_convertvector(columns, Twos), Fours);
    return std::bit_cast<Vector>(step | step << 16);
  }
  VLA_INLINE void fetch(std::int64_t /*k*/, int /*s*/, int /*i*/) const {}
};

template <int kStrips>
struct Int4Panels::Strips : Int4Codes::Strips<kStrips> {
  using Packed = Int4Codes::Strips<kStrips>;
  using Packed::Packed;

  template <class Vector>
  VLA_INLINE Vector load(std::int64_t k, int s, int i, int byte) const {
    using Pairs = typename VectorOf<std::uint16_t, sizeof(Vector)>::Type;
    const auto step = Packed::template step<Pairs>(k, i, byte);
    // Multiplies two bytes at once. An offset keeps each product and difference in 0 to 255, so that it does not carry
    // into its neighbour.
    const auto codes = Packed::template load<Pairs>(k, s, i, byte);
    const auto numbers = codes * step + (kHalf * kBoth - step * (Int4Block::kZero * kBoth));
    return std::bit_cast<Vector>(numbers ^ (kHalf - kOffset) * kBoth);
  }

 private:
  static constexpr std::uint16_t kHalf = 128, kBoth = 0x0101;
};
static_assert(15 * Int4Block::kMaxStep <= 255 && Int4Block::kMost * Int4Block::kMaxStep < 128);

/// Elements of a panel expanded to bytes: lines of 64 with four elements of 16 columns, for each strip, then the next
/// four elements. fetch(k, s, i) prefetches the line that is loaded kAhead groups later, because a long step lies in
/// the L2 cache.
template <int kStrips, class Packed>
struct ExpandedStrips {
  static constexpr std::int64_t kAhead = 8;
  const std::byte* lines;
  const Packed& packed;

  template <class Vector>
  VLA_INLINE Vector load(std::int64_t k, int s, int i, int byte) const {
    Vector numbers;
    std::memcpy(&numbers, line(k + 4 * s, i) + byte, sizeof(numbers));
    return numbers;
  }
  VLA_INLINE void fetch(std::int64_t k, int s, int i) const { __builtin_prefetch(line(k + 4 * (s + kAhead), i)); }
  VLA_INLINE const std::byte* line(std::int64_t k, int i) const {
    return lines + k * kStrips * 16 + i * Int8Panels::kLine;
  }
  template <class Vector>
  VLA_INLINE Vector step(std::int64_t k, int i, int byte) const {
    return packed.template step<Vector>(k, i, byte);
  }
};

/// Used for the first read of a panel: load expands a vector and also writes it to `lines`.
template <int kStrips, class Packed>
struct ExpandingStrips {
  std::byte* lines;
  const Packed& packed;

  template <class Vector>
  VLA_INLINE Vector load(std::int64_t k, int s, int i, int byte) const {
    const auto numbers = packed.template load<Vector>(k, s, i, byte);
    std::memcpy(lines + (k + 4 * s) * kStrips * 16 + i * Int8Panels::kLine + byte, &numbers, sizeof(numbers));
    return numbers;
  }
  VLA_INLINE void fetch(std::int64_t /*k*/, int /*s*/, int /*i*/) const {}
};

/// Writes the lines that ExpandedStrips reads for `depth` elements starting at k, kUnit at a time; Vector is as wide as
/// the machine's.
template <class Vector, int kStrips, int kUnit = kQuantizedUnit, class Strips>
VLA_INLINE void expand(const Strips& strips, std::int64_t k, std::int64_t depth, std::byte* to) {
  for (const std::int64_t end = k + depth; k < end; k += kUnit)
#pragma GCC unroll 4
    for (int i = 0; i < kStrips; ++i)
#pragma GCC unroll 8
      for (int byte = 0; byte < Int8Panels::kLine; byte += static_cast<int>(sizeof(Vector)))
#pragma GCC unroll 16
        for (int s = 0; s < kUnit / 4; ++s) {
          const auto numbers = strips.template load<Vector>(k, s, i, byte);
          std::memcpy(to + ((k - end + depth) / 4 + s) * kStrips * Int8Panels::kLine + i * Int8Panels::kLine + byte,
                      &numbers, sizeof(numbers));
        }
}

}  // namespace vla::kernels
