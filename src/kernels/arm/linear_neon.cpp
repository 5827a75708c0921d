// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/arm/neon_multiply_add.h"
#include "kernels/linear_loop.h"
#include "kernels/tile_heights.h"

namespace vla::kernels {
namespace {

/// 6 rows by 4 vectors: 24 of the 32 registers hold sums. One load reads four elements of a row of x; a multiply-add
/// selects one of them by lane.
struct NeonTile {
  using V = Neon;
  using X = float;
  static constexpr int kRows = 6, kColumns = 16, kVectors = kColumns / V::width;
  static constexpr int kMaxDepth = 2048, kStep = 512, kBlockRows = 54;
  // not a multiple of a page, so that rows do not compete for the same cache lines
  static constexpr int kXStride = kMaxDepth + 16;
  static constexpr bool kEven = true, kRounds = false;

  static VLA_INLINE void copy(const float* from, std::int64_t n, float* to) { copy_padded(from, n, to); }

  static void multiply(DType type, int n_row, const float* x, const std::byte* panel, std::int64_t depth, float* c,
                       bool add, const Prefetch& ahead) {
    with_height<kRows>(n_row, [&]<int n>() {
      if (type == DType::bf16)
        tile<n, Pairs>(x, panel, depth, c, add, ahead.from);
      else if (type == DType::f16)
        tile<n, Halves>(x, panel, depth, c, add, ahead.from);
      else
        tile<n, Floats>(x, panel, depth, c, add, ahead.from);
    });
  }

 private:
  using Float = V::Float;

  // How a panel stores elements: bytes for four steps of the depth, the place of columns 4 n to 4 n + 3 of step k, the
  // instructions that add them to the sums of six rows, and the columns as floats.
  struct Floats {
    static constexpr int kSize = 256;
    static constexpr int place(int k, int n) { return 64 * k + 16 * n; }
    template <int k>
    static VLA_INLINE void add(const std::byte* from, const Float (&rows)[6], Float zero, Float (&sums)[6]) {
      multiply_add_floats<k>(from, rows, zero, sums);
    }
    static VLA_INLINE Float load(const std::byte* from, int) { return V::load(reinterpret_cast<const float*>(from)); }
  };
  struct Halves {
    static constexpr int kSize = 128;
    static constexpr int place(int k, int n) { return 32 * k + 8 * n; }
    template <int k>
    static VLA_INLINE void add(const std::byte* from, const Float (&rows)[6], Float zero, Float (&sums)[6]) {
      multiply_add_halves<k>(from, rows, zero, sums);
    }
    static VLA_INLINE Float load(const std::byte* from, int) {
      float16x4_t halves;
      std::memcpy(&halves, from, sizeof(halves));
      return vcvt_f32_f16(halves);
    }
  };
  struct Pairs {
    static constexpr int kSize = 128;
    static constexpr int place(int k, int n) { return 64 * (k / 2) + 16 * n; }
    template <int k>
    static VLA_INLINE void add(const std::byte* from, const Float (&rows)[6], Float zero, Float (&sums)[6]) {
      if constexpr (k % 2 == 0)
        multiply_add_firsts<k>(from, rows, zero, sums);
      else
        multiply_add_seconds<k>(from, rows, zero, sums);
    }
    static VLA_INLINE Float load(const std::byte* from, int k) {
      V::Int words;
      std::memcpy(&words, from, sizeof(words));
      return std::bit_cast<Float>(k % 2 == 0 ? words << 16 : words & ~0xffff);
    }
  };

  template <int kCount, class Line>
  static void tile(const float* x, const std::byte* line, std::int64_t depth, float* c, bool add,
                   const std::byte* ahead) {
    const Float zero = {};
    Float sums[kVectors][kCount];
#pragma GCC unroll 4
    for (auto& column : sums)
#pragma GCC unroll 6
      for (Float& sum : column) sum = zero;
    for (const float* end = x + depth; x < end; x += 4, line += Line::kSize, ahead += 16) {
      __builtin_prefetch(ahead, 0, 2);  // prefetch to L2
      Float rows[kCount];
#pragma GCC unroll 6
      for (int r = 0; r < kCount; ++r) rows[r] = V::load(x + r * kXStride);
      step<0, kCount, Line>(line, rows, zero, sums);
      step<1, kCount, Line>(line, rows, zero, sums);
      step<2, kCount, Line>(line, rows, zero, sums);
      step<3, kCount, Line>(line, rows, zero, sums);
    }
#pragma GCC unroll 6
    for (int r = 0; r < kCount; ++r)
#pragma GCC unroll 4
      for (int n = 0; n < kVectors; ++n) {
        float* place = c + r * kColumns + V::width * n;
        V::store(place, add ? sums[n][r] + V::load(place) : sums[n][r]);
      }
  }

  template <int k, int kCount, class Line>
  static VLA_INLINE void step(const std::byte* line, const Float (&rows)[kCount], Float zero,
                              Float (&sums)[kVectors][kCount]) {
#pragma GCC unroll 4
    for (int n = 0; n < kVectors; ++n) {
      const std::byte* from = line + Line::place(k, n);
      if constexpr (kCount == 6) {
        Line::template add<k>(from, rows, zero, sums[n]);
      } else {
        const Float columns = Line::load(from, k);
#pragma GCC unroll 6
        for (int r = 0; r < kCount; ++r) sums[n][r] = vfmaq_laneq_f32(sums[n][r], columns, rows[r], k);
      }
    }
  }
};

bool supports_neon(const MatrixDesc& desc, Features use) { return use.has(Feature::neon) && is_float(desc.type); }

}  // namespace

extern const LinearKernel kLinearNeon;
const LinearKernel kLinearNeon = LinearLoop<NeonTile>::kernel("neon", supports_neon);

}  // namespace vla::kernels
