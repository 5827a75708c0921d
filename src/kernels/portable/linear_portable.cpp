// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/linear_loop.h"
#include "kernels/portable/vec_portable.h"
#include "kernels/tile_heights.h"

namespace vla::kernels {
namespace {

/// 3 rows by 4 vectors: 12 sums, which fit into the 16 vector registers that every machine has. Products and sums are
/// rounded separately, in the order of the depth, so every machine gives the same bits.
struct PortableTile {
  using V = Portable;
  using X = float;
  static constexpr int kRows = 3, kColumns = 16, kVectors = kColumns / V::width;
  static constexpr int kMaxDepth = 2048, kStep = 512, kBlockRows = 48;
  // not a multiple of a page, so that rows do not compete for the same cache lines
  static constexpr int kXStride = kMaxDepth + 16;
  static constexpr bool kEven = true, kRounds = false;

  static VLA_INLINE void copy(const float* from, std::int64_t n, float* to) { copy_padded(from, n, to); }

  static void multiply(DType type, int n_row, const float* x, const std::byte* panel, std::int64_t depth, float* c,
                       bool add, const Prefetch&) {
    with_height<kRows>(n_row, [&]<int n>() {
      if (type == DType::bf16)
        tile<n, Pairs>(x, panel, depth, c, add);
      else if (type == DType::f16)
        tile<n, Halves>(x, panel, depth, c, add);
      else
        tile<n, Floats>(x, panel, depth, c, add);
    });
  }

 private:
  using Float = V::Float;
  using Int = V::Int;

  // Steps of the depth per line of a panel, and four columns of one step as floats.
  struct Pairs {
    static constexpr int kDepth = 2, kSize = 64;
    static VLA_INLINE Float load(const std::byte* line, int k, int i) {
      Int words;
      std::memcpy(&words, line + 16 * i, sizeof(words));
      return std::bit_cast<Float>(k == 0 ? words << 16 : words & ~0xffff);
    }
  };
  struct Halves {
    static constexpr int kDepth = 1, kSize = 32;
    /// Adds 112 to the exponent's bias; infinity and NaN get the largest exponent.
    static VLA_INLINE Float load(const std::byte* line, int, int i) {
      typedef std::uint16_t Words __attribute__((vector_size(8)));
      Words halves;
      std::memcpy(&halves, line + 8 * i, sizeof(halves));
      const Int x = __builtin_convertvector(halves, Int), size = x & 0x7fff;
      const Int finite = std::bit_cast<Int>(std::bit_cast<Float>(size << 13) * 0x1p112f);
      return std::bit_cast<Float>((x & 0x8000) << 16 | (size < 0x7c00 ? finite : size << 13 | 0x7f800000));
    }
  };
  struct Floats {
    static constexpr int kDepth = 1, kSize = 64;
    static VLA_INLINE Float load(const std::byte* line, int, int i) {
      return V::load(reinterpret_cast<const float*>(line) + V::width * i);
    }
  };

  template <int kCount, class Line>
  static void tile(const float* x, const std::byte* line, std::int64_t depth, float* c, bool add) {
    Float sums[kCount][kVectors] = {};
    for (std::int64_t i = 0; i < depth; i += Line::kDepth, line += Line::kSize)
#pragma GCC unroll 2
      for (int k = 0; k < Line::kDepth; ++k) {
#pragma GCC unroll 4
        for (int n = 0; n < kVectors; ++n) {
          const Float columns = Line::load(line, k, n);
#pragma GCC unroll 3
          for (int r = 0; r < kCount; ++r) sums[r][n] += x[r * kXStride + i + k] * columns;
        }
      }
    for (int r = 0; r < kCount; ++r)
      for (int n = 0; n < kVectors; ++n) {
        float* place = c + r * kColumns + n * V::width;
        V::store(place, add ? V::load(place) + sums[r][n] : sums[r][n]);
      }
  }
};

bool supports(const MatrixDesc& desc, Features use) { return use.has(Feature::baseline) && is_float(desc.type); }

}  // namespace

extern const LinearKernel kLinearPortable;
const LinearKernel kLinearPortable = LinearLoop<PortableTile>::kernel("portable", supports);

}  // namespace vla::kernels
