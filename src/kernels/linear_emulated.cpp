// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/linear_pairs.h"

namespace vla::kernels {
namespace {

/// A tile of odd sizes that reads numbers of any type from panels of 16 columns, as the AVX2 tile does.
struct FloatTile {
  using V = Portable;
  using X = float;
  static constexpr int kRows = 5, kColumns = 16;
  static constexpr int kMaxDepth = 96, kManyDepth = 64, kStep = 32, kBlockRows = 10, kSplitRows = 0;
  static constexpr int kXStride = kMaxDepth + 1;
  static constexpr bool kEven = true, kRounds = false;
  struct Session {};

  static void copy(const float* from, std::int64_t n, float* to, float*) { copy_padded(from, n, to); }
  static void multiply(DType type, int n_row, const float* x, const float*, const std::byte* panel, std::int64_t depth,
                       float* c, bool add, const Ahead&) {
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
struct EmulatedAmxTile : PairTile {
  using V = Portable;
  struct Session {};

  static void store_rounded(X* to, V::Float x, std::int64_t left) {
    for (int i = 0; i < V::width && i < left; ++i) to[i] = to_bf16(x[i]);
  }

  static void copy(const float* from, std::int64_t n, X* to, X* rest) {
    for (std::int64_t i = 0; i < n; ++i) to[i] = to_bf16(from[i]);
    for (std::int64_t i = n; i % kPanelDepth != 0; ++i) to[i] = 0;
    if (rest == nullptr) return;
    for (std::int64_t i = 0; i < n; ++i) rest[i] = to_bf16(from[i] - from_bf16(to[i]));
    for (std::int64_t i = n; i % kPanelDepth != 0; ++i) rest[i] = 0;
  }

  static void multiply(DType type, int n_row, const X* x, const X* rest, const std::byte* panel, std::int64_t depth,
                       float* c, bool add, const Ahead&) {
    for (int r = 0; r < n_row; ++r)
      for (int n = 0; n < kColumns; ++n) {
        float sum = 0;
        for (std::int64_t k = 0; k < depth; ++k) {
          const float w = Panels<kColumns>::number(type, panel, k, n);
          sum += from_bf16(x[r * kXStride + k]) * w;
          if (rest != nullptr) sum += from_bf16(rest[r * kXStride + k]) * w;
        }
        c[r * kColumns + n] = add ? c[r * kColumns + n] + sum : sum;
      }
  }
};

bool any(const MatrixDesc& desc, Isa) { return is_float(desc.type); }
bool bf16_only(const MatrixDesc& desc, Isa) { return desc.type == DType::bf16; }

constexpr LinearKernel kFloat = LinearLoop<FloatTile>::kernel("emulated", any);
constexpr LinearKernel kPair = LinearLoop<EmulatedAmxTile>::kernel("emulated_amx", bf16_only);

}  // namespace

std::span<const LinearKernel* const> emulated_linear_kernels() {
  static constexpr const LinearKernel* kAll[] = {&kFloat, &kPair};
  return kAll;
}

}  // namespace vla::kernels
