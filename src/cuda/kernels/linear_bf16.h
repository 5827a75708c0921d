// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/kernels/epilogue.h"
#include "cuda/kernels/launch.h"

/// Products of rows and a bf16 matrix with sums in float32, and the epilogue. Tensor cores take rows of bf16. For few
/// rows x stays float32, since rounding it would save nothing.
namespace vla::cuda {

/// Rotates the pairs (y_i, y_{i + d_head/2}) of each head, as HeadJob does; d_head is a multiple of 8.
struct Rotation {
  const float* table = nullptr;  // [d_head, n_token]: cosines, then sines of each token; null: nothing is rotated
  int d_head = 0, n_token = 0;

  /// The column of a pair's first element. Pairs are numbered through all heads.
  VLA_HOST_DEVICE int first_column(int pair) const {
    const int half = d_head / 2;
    return pair / half * d_head + pair % half;
  }
};

/// Rows that follow those of y where a norm is halved: of a layer norm's weight, and of a bias, two each (NormBegin).
VLA_HOST_DEVICE constexpr int rows_of_norm(bool is_layer, bool has_bias) {
  return (is_layer ? 2 : 0) + (has_bias ? 2 : 0);
}
/// What a product that begins a norm leaves of its rows: sums over parts of `part` columns each, the last part may have
/// fewer.
struct RowMoments {
  float* squares = nullptr;  // [n_row, n_part]: squares of y, or for a layer norm of y minus the part's mean
  float* sums = nullptr;     // [n_row, n_part], or null for an RMS norm
  int n_part = 0, part = 0;
};
/// The first half of a norm of y; products of the norm do the other half (NormEnd).
struct NormBegin {
  /// y * weight in bf16, with a stride that is even. The rows that NormEnd::n_more() counts follow: for a layer norm
  /// the weight, and if there is one the bias, each as two rows, rounded and what that lacks. Null: no norm begins.
  std::uint16_t* rows = nullptr;
  std::int64_t stride = 0;
  const float *weight = nullptr, *bias = nullptr;  // [n_column], or null
  RowMoments moments = {};
};
/// The other half: x is such rows, of x' without the norm. The norm's product is factor * (x' w^T - mean * weight w^T)
/// + bias w^T with factor = 1 / sqrt(variance + eps), for an RMS norm with a mean of 0.
struct NormEnd {
  RowMoments moments = {};  // without squares: x has no norm to end
  float eps = 0;
  bool has_bias = false;

  /// Rows of x after the last of y. With such rows, a block must have all rows.
  VLA_HOST_DEVICE int n_more() const { return rows_of_norm(moments.sums != nullptr, has_bias); }
};

struct LinearBf16Job {
  // n_row rows with stride x_stride: float32 for few rows, else bf16 with a stride that is a multiple of 8
  const void* x;
  const std::uint16_t* weight;  // n_column rows with stride weight_stride, a multiple of 8
  std::int64_t x_stride, weight_stride;
  int n_row, n_column, depth;  // elements of a row after the depth are ignored
  /// With more than one split, each writes its sums over a share of the depth to partial [n_sum(), n_row_x(), n_split];
  /// `finish_bf16_partial` adds them in order and computes y. Without `partial`, Hopper's tiles add them in the same
  /// order in clusters of up to kMaxCluster blocks.
  int n_split;
  float* partial;
  Epilogue end;
  /// Only for strips and Hopper's tiles: computes the gate in the same kernel instead of reading end.gate, y =
  /// activation(x gate^T + gate_bias) * (x w^T + bias) and so on. Rows of `partial` then have the gate's sums first.
  const std::uint16_t* gate_weight = nullptr;
  const float* gate_bias = nullptr;
  /// Only for strips of up to 64 columns, or where finish_bf16_partial adds the shares: y = rotated(x w^T + bias).
  Rotation rotation = {};
  /// Only for undivided strips of up to 64 columns without halves, and Hopper's tiles that have a kernel for it, if
  /// they compute y: without activation, gate and final ReLU.
  NormBegin norm_begin = {};
  /// Only for strips and Hopper's tiles, and with n_more() == 0 for any product whose shares finish_bf16_partial adds.
  NormEnd norm_end = {};

  VLA_HOST_DEVICE int n_sum() const { return gate_weight ? 2 * n_column : n_column; }  // per row
  VLA_HOST_DEVICE int n_row_x() const { return n_row + norm_end.n_more(); }
};

/// The shape of a block. few: kBf16FewRows rows, where reading the matrix once is the bottleneck. stripN: N columns and
/// up to 64 rows, with loads of much of the depth in flight; the depth must be a multiple of 8. rowsN: N rows and N
/// columns on tensor cores.
enum class Bf16Shape { few, strip16, strip32, strip64, strip128, rows64, rows128 };
constexpr int kBf16FewRows = 8;
constexpr int kBf16Depth = 32;  // step of the depth, and unit of a split

/// Columns of a strip, half of them the gate's where there is one; 0 for other shapes.
constexpr unsigned strip_width(Bf16Shape shape) {
  switch (shape) {
    case Bf16Shape::strip16:
      return 16;
    case Bf16Shape::strip32:
      return 32;
    case Bf16Shape::strip64:
      return 64;
    case Bf16Shape::strip128:
      return 128;
    default:
      return 0;
  }
}
/// Columns of a part of NormBegin's rows, for strips of this width; 64 for Hopper's tiles.
constexpr int norm_part(unsigned width) { return width < 64 ? static_cast<int>(width) : 64; }
inline Launch linear_strip(unsigned width, const LinearBf16Job& job) {
  constexpr const char* kNames[4][4] = {
      {"linear_strip_16", "linear_strip_32", "linear_strip_64", "linear_strip_128"},
      {"linear_strip_16_gated", "linear_strip_32_gated", "linear_strip_64_gated", "linear_strip_128_gated"},
      {"linear_strip_16_rotated", "linear_strip_32_rotated", "linear_strip_64_rotated"},
      {"linear_strip_16_begins", "linear_strip_32_begins", "linear_strip_64_begins"}};
  const int kind = job.gate_weight != nullptr                          ? 1
                   : job.rotation.table != nullptr && job.n_split == 1 ? 2
                   : job.norm_begin.rows != nullptr                    ? 3
                                                                       : 0;
  const int which = width == 16 ? 0 : width == 32 ? 1 : width == 64 ? 2 : 3;
  const unsigned n_sum = width == 128 ? 2 : width == 64 ? 4 : 8;  // warps that have the same columns
  return {kNames[kind][which],
          {blocks(job.n_sum(), width), blocks(job.n_row, 64), static_cast<unsigned>(job.n_split)},
          256,
          (n_sum * 64 * (width + 8) + 2 * 64) * 4};
}
/// Several products in strips of the same width, rows and depth, without gates and splits. If any is rotated, all must
/// have a multiple of four columns.
inline Launch linear_strips(unsigned width, Several<LinearBf16Job>& jobs) {
  constexpr const char* kNames[2][3] = {
      {"linear_strips_16", "linear_strips_32", "linear_strips_64"},
      {"linear_strips_16_rotated", "linear_strips_32_rotated", "linear_strips_64_rotated"}};
  Launch launch = linear_strip(width, jobs.job[0]);
  bool rotates = false;
  for (int i = 0; i < jobs.n; ++i) rotates = rotates || jobs.job[i].rotation.table != nullptr;
  launch.kernel = kNames[rotates][width == 16 ? 0 : width == 32 ? 1 : 2];
  for (int i = 0; i < jobs.n; ++i)
    if (jobs.job[i].rotation.table == nullptr) jobs.job[i].rotation.d_head = jobs.job[i].n_column;  // one head
  launch.grid.x = fill_ends(jobs, [&](const LinearBf16Job& one) { return blocks(one.n_column, width); });
  return launch;
}

inline Launch linear_bf16(Bf16Shape shape, const LinearBf16Job& job) {
  const auto splits = static_cast<unsigned>(job.n_split);
  if (shape == Bf16Shape::few)
    return {"linear_bf16_few", {blocks(job.n_column, 8), blocks(job.n_row, kBf16FewRows), splits}, 128};
  if (const unsigned width = strip_width(shape)) return linear_strip(width, job);
  const unsigned size = shape == Bf16Shape::rows64 ? 64 : 128;
  return {shape == Bf16Shape::rows64 ? "linear_bf16_64" : "linear_bf16_128",
          {blocks(job.n_column, size), blocks(job.n_row, size), splits},
          128,
          4 * 2 * size * kBf16Depth * 2};
}

/// Tiles of the kernels for Hopper only (hopper_linear_bf16.cu): columns, a multiple of 64, and rows, a multiple of 16.
/// These have a second kernel, for several products in one launch, and a third, which begins a norm:
#define VLA_HOPPER_BEGINNING_TILES(each) each(64, 64) each(128, 48) each(128, 64)
/// These have the second:
#define VLA_HOPPER_SEVERAL_TILES(each) \
  each(128, 96) each(128, 112) each(128, 128) each(128, 192) each(192, 112) each(192, 192)
#define VLA_HOPPER_OTHER_TILES(each)                                                                     \
  each(192, 48) each(64, 128) each(128, 144) each(128, 160) each(128, 176) each(128, 224) each(128, 256) \
      each(192, 160) each(192, 224) each(256, 112) each(256, 128) each(256, 160)
#define VLA_HOPPER_TILES(each) \
  VLA_HOPPER_BEGINNING_TILES(each) VLA_HOPPER_SEVERAL_TILES(each) VLA_HOPPER_OTHER_TILES(each)
/// The same for gated products. Half of a tile's columns belong to the gate's matrix, half to the other.
#define VLA_HOPPER_GATED_TILES(each)                                                                     \
  each(128, 64) each(128, 96) each(128, 128) each(128, 160) each(128, 192) each(128, 224) each(128, 256) \
      each(256, 112) each(256, 128) each(256, 160)
struct HopperTile {
  const char* kernel;
  int columns, rows;
  bool is_gated = false;
  const char* several = nullptr;  // the kernel of several products
  const char* begins = nullptr;   // the kernel that begins a norm
};
constexpr HopperTile kHopperTiles[] = {
#define VLA_HOPPER_TILE(columns, rows)                                                                                 \
  {"hopper_linear_bf16_" #columns "x" #rows,          columns, rows, false, "hopper_linears_bf16_" #columns "x" #rows, \
   "hopper_linear_bf16_" #columns "x" #rows "_begins"},
    VLA_HOPPER_BEGINNING_TILES(VLA_HOPPER_TILE)
#undef VLA_HOPPER_TILE
#define VLA_HOPPER_TILE(columns, rows) \
  {"hopper_linear_bf16_" #columns "x" #rows, columns, rows, false, "hopper_linears_bf16_" #columns "x" #rows},
        VLA_HOPPER_SEVERAL_TILES(VLA_HOPPER_TILE)
#undef VLA_HOPPER_TILE
#define VLA_HOPPER_TILE(columns, rows) {"hopper_linear_bf16_" #columns "x" #rows, columns, rows},
            VLA_HOPPER_OTHER_TILES(VLA_HOPPER_TILE)
#undef VLA_HOPPER_TILE
#define VLA_HOPPER_TILE(columns, rows) {"hopper_linear_bf16_" #columns "x" #rows "_gated", columns, rows, true},
                VLA_HOPPER_GATED_TILES(VLA_HOPPER_TILE)
#undef VLA_HOPPER_TILE
};
constexpr int kHopperDepth = 64;  // step of the depth, and unit of a split: each share has at least one
/// Bytes of a step, and the number of steps in shared memory: eight, or fewer if kHopperShared holds fewer.
constexpr int hopper_stage_bytes(int columns, int rows) { return (columns + rows) * kHopperDepth * 2; }
constexpr int hopper_stages(int columns, int rows) {
  const int most = static_cast<int>(kHopperShared) / hopper_stage_bytes(columns, rows);
  return most < 8 ? most : 8;
}
inline Launch hopper_linear_bf16(const HopperTile& tile, const LinearBf16Job& job) {
  // Adjacent blocks read the same columns, so the matrix is read from memory once.
  return {job.norm_begin.rows != nullptr ? tile.begins : tile.kernel,
          {blocks(job.n_row, tile.rows), blocks(job.n_column, tile.is_gated ? tile.columns / 2 : tile.columns),
           static_cast<unsigned>(job.n_split)},
          static_cast<unsigned>(tile.columns) * 2,
          static_cast<unsigned>(hopper_stages(tile.columns, tile.rows) * hopper_stage_bytes(tile.columns, tile.rows)),
          cluster_of(job)};
}
/// Several products of the same rows, depth and number of shares, without gates.
inline Launch hopper_linears_bf16(const HopperTile& tile, Several<LinearBf16Job>& jobs) {
  Launch launch = hopper_linear_bf16(tile, jobs.job[0]);
  launch.kernel = tile.several;
  launch.grid.y = fill_ends(jobs, [&](const LinearBf16Job& one) { return blocks(one.n_column, tile.columns); });
  return launch;
}

inline Launch finish_bf16_partial(const LinearBf16Job& job) {
  const int n_four = job.rotation.table != nullptr ? job.n_column / 8 : (job.n_column + 3) / 4;
  return {"linear_bf16_finish", {blocks(n_four, 128), static_cast<unsigned>(job.n_row)}, 128};
}
inline Launch finish_bf16_partials(Several<LinearBf16Job>& jobs) {
  const unsigned n_block = fill_ends(jobs, [](const LinearBf16Job& one) { return finish_bf16_partial(one).grid.x; });
  return {"linear_bf16_finishes", {n_block, static_cast<unsigned>(jobs.job[0].n_row)}, 128};
}

}  // namespace vla::cuda
