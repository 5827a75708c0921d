// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/linear_kernel.h"
#include "kernels/linear_loop.h"
#include "kernels/linear_pairs.h"

namespace vla::kernels {
namespace {

/// A tile of odd sizes that reads panels of floats, as the AVX tiles do.
struct FloatTile {
  using V = Portable;
  using X = float;
  static constexpr int kRows = 5, kColumns = 3, kDepth = 4;
  static constexpr int kMaxDepth = 20, kBlockRows = 10, kBlockColumns = 12, kXStride = kMaxDepth + 1;
  static constexpr int kPackCost = 1, kCopyCost = 1;
  static constexpr bool kPacked = false, kEven = true;
  struct Session {};

  static std::size_t panel_size(DType, std::int64_t depth) {
    return static_cast<std::size_t>(depth) * kColumns * sizeof(float);
  }
  static void copy(const float* from, std::int64_t n, float* to) {
    for (std::int64_t i = 0; i < round_up(n, kDepth); ++i) to[i] = i < n ? from[i] : 0;
  }
  static void pack(DType type, const std::byte* rows, std::int64_t d_in, std::int64_t n_column, std::int64_t depth,
                   std::byte* panel) {
    auto* out = reinterpret_cast<float*>(panel);
    for (std::int64_t k = 0; k < round_up(depth, kDepth); ++k)
      for (std::int64_t n = 0; n < kColumns; ++n)
        out[k * kColumns + n] = n < n_column && k < depth ? stored_number(type, rows, n * d_in + k) : 0;
  }
  static void multiply(DType, int n_row, const float* x, const std::byte* panel, std::int64_t depth, float* c,
                       std::int64_t stride, bool add) {
    const auto* w = reinterpret_cast<const float*>(panel);
    for (int r = 0; r < n_row; ++r)
      for (int n = 0; n < kColumns; ++n) {
        float sum = 0;
        for (std::int64_t k = 0; k < depth; ++k) sum += x[r * kXStride + k] * w[k * kColumns + n];
        c[r * stride + n] = add ? c[r * stride + n] + sum : sum;
      }
  }
};

/// The tile of linear_amx.cpp in plain C++: the same panels, packed at load, and the same rounding of x to bf16.
struct PairTile : PairPanels {
  using V = Portable;
  struct Session {};

  static void multiply(DType, int n_row, const std::uint16_t* x, const std::byte* panel, std::int64_t depth, float* c,
                       std::int64_t stride, bool add) {
    for (int r = 0; r < n_row; ++r)
      for (int n = 0; n < kColumns; ++n) {
        float sum = 0;
        for (std::int64_t k = 0; k < depth; ++k)
          sum += from_bf16(x[r * kXStride + k]) * from_bf16(reinterpret_cast<const std::uint16_t*>(panel)[place(k, n)]);
        c[r * stride + n] = add ? c[r * stride + n] + sum : sum;
      }
  }
};

bool any(const MatrixDesc& desc, Isa) { return desc.type != DType::i32; }
bool bf16_only(const MatrixDesc& desc, Isa) { return desc.type == DType::bf16; }

constexpr LinearKernel kFloat = {
    {"emulated", nullptr, nullptr}, any, LinearLoop<FloatTile>::run, LinearLoop<FloatTile>::kScratchSize};
constexpr LinearKernel kPair = {{"emulated_amx", LinearLoop<PairTile>::packed_size, LinearLoop<PairTile>::pack},
                                bf16_only,
                                LinearLoop<PairTile>::run,
                                LinearLoop<PairTile>::kScratchSize};

}  // namespace

std::span<const LinearKernel* const> emulated_linear_kernels() {
  static constexpr const LinearKernel* kAll[] = {&kFloat, &kPair};
  return kAll;
}

}  // namespace vla::kernels
