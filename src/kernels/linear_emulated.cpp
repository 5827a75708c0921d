// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <vector>

#include "kernels/linear_loop.h"
#include "kernels/linear_tiles.h"

namespace vla::kernels {
namespace {

/// A tile of odd sizes that reads numbers of any type from panels of 16 columns, as the AVX2 tile does.
struct FloatTile {
  using V = Portable;
  using X = float;
  static constexpr int kRows = 5, kColumns = 16;
  static constexpr int kMaxDepth = 96, kStep = 32, kBlockRows = 10;
  static constexpr int kXStride = kMaxDepth + 1;
  static constexpr bool kEven = true, kRounds = false;

  static void copy(const float* from, std::int64_t n, float* to) { copy_padded(from, n, to); }
  static void multiply(DType type, int n_row, const float* x, const std::byte* panel, std::int64_t depth, float* c,
                       bool add, const Ahead&) {
    for (int r = 0; r < n_row; ++r)
      for (int n = 0; n < kColumns; ++n) {
        float sum = 0;
        for (std::int64_t k = 0; k < depth; ++k)
          sum += x[r * kXStride + k] * Panels<kColumns>::number(type, panel, k, n);
        c[r * kColumns + n] = add ? c[r * kColumns + n] + sum : sum;
      }
  }
};

/// The tile of linear_amx.cpp in plain C++: the same panels, and the same rounding of x to bf16.
struct EmulatedAmxTile {
  using V = Portable;
  struct Session {};

  static void store_rounded(std::uint16_t* to, V::Float x, std::int64_t left) {
    for (int i = 0; i < V::width && i < left; ++i) to[i] = to_bf16(x[i]);
  }

  static void copy(const float* from, std::int64_t n, std::uint16_t* to) {
    for (std::int64_t i = 0; i < kSquare; ++i) to[i] = i < n ? to_bf16(from[i]) : 0;
  }

  template <class Between>
  static void multiply(bool half, const std::uint16_t* x, const std::byte* panel, std::int64_t n_square, float* c,
                       bool add, Between& between) {
    const std::int64_t n_row = half ? kSquare / 2 : kSquare;
    std::vector<float> sums(c, c + (add ? n_row * kSquare : 0));
    sums.resize(static_cast<std::size_t>(n_row * kSquare));
    for (std::int64_t k = 0; k < n_square * kSquare; ++k) {
      if (k % kSquare == 0) between();
      for (std::int64_t r = 0; r < n_row; ++r)
        for (std::int64_t n = 0; n < kSquare; ++n)
          sums[static_cast<std::size_t>(r * kSquare + n)] += from_bf16(x[place_in_tiles(r, k, n_square * kSquare)]) *
                                                             Panels<kSquare>::number(DType::bf16, panel, k, n);
    }
    std::copy(sums.begin(), sums.end(), c);
  }
};

bool any(const MatrixDesc& desc, Features) { return is_float(desc.type); }
bool bf16_only(const MatrixDesc& desc, Features) { return desc.type == DType::bf16; }

constexpr LinearKernel kFloat = LinearLoop<FloatTile>::kernel("emulated", any);
constexpr LinearKernel kPair = TileLoop<EmulatedAmxTile>::kernel("emulated_amx", bf16_only);

}  // namespace

std::span<const LinearKernel* const> emulated_linear_kernels() {
  static constexpr const LinearKernel* kAll[] = {&kFloat, &kPair};
  return kAll;
}

}  // namespace vla::kernels
