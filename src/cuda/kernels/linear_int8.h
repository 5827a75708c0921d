// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/kernels/epilogue.h"
#include "cuda/kernels/launch.h"

/// Products of int8 rows and a matrix of ternary, int4 or int8 codes: exact sums, then float(sum) * (scale of the
/// column / scale of the row) and the epilogue. Every operation is rounded separately, as in the kernels for CPUs
/// (kernels/quantized.h).
namespace vla::cuda {

/// Rows of codes have the layout of kernels/quantized.h: codes padded with zeros to a multiple of 64, then 64 bytes
/// that begin with the row's scale (float) and the sum of its codes (int).
///
/// A packed matrix is a sequence of tiles of 32 columns and 64 of the depth, along the depth first. Lane l of a warp
/// owns column l / 4 of every eight. Byte b of its register for fragment s (0 to 3) is at depth 16 s + 4 (l % 4) + b.
/// int8: 2048 bytes per tile. For every eight columns a lane has 16 bytes, the registers of its four fragments.
/// ternary: 512 bytes. A lane has 16 bytes, a word for every eight columns. Byte b of a word holds code + 1 in two bits
/// for each fragment, the first fragment lowest, so that a shift by 2 s and a mask give the register. The 1 adds the
/// row's sum of codes to every product, which is subtracted at the end.
/// int4: 1056 bytes. For every sixteen columns a lane has 16 bytes, two words for each eight of them. Byte b of the
/// first word holds the codes of fragments 0 and 1, the lower four bits first; the second word holds those of 2 and 3.
/// The columns' steps (Int4Block) follow: word i, from 0 to 7, holds the steps of column i of each eight.
struct Int8Tile {
  static constexpr int kColumns = 32, kDepth = 64;
};
enum class CodeKind { ternary, int4, int8 };
/// Bytes of a column of a tile.
constexpr int column_bytes(CodeKind kind) { return kind == CodeKind::ternary ? 16 : kind == CodeKind::int4 ? 33 : 64; }
constexpr int tile_bytes(CodeKind kind) { return Int8Tile::kColumns * column_bytes(kind); }
template <CodeKind kKind>
constexpr int kTileBytes = tile_bytes(kKind);

struct LinearInt8Job {
  const std::byte* x;  // n_row rows of codes
  const std::byte* weight;
  const float* scale;  // [n_column]
  std::int64_t x_stride;
  int n_row, n_column, depth;  // depth: a multiple of 64
  /// With more than one split, each writes its sums over a share of the depth to partial [n_column, n_row, n_split];
  /// `finish_int8_partial` computes y from them. Sums are integers, so the bits stay the same. Without `partial`,
  /// Hopper's tiles add them in clusters of up to kMaxCluster blocks.
  int n_split;
  int* partial;
  Epilogue end;
};

/// Bytes of a packed matrix.
std::size_t packed_int8_size(CodeKind kind, std::int64_t d_in, std::int64_t d_out);
/// stored: d_out rows of d_in elements as in a bundle: int8, ternary in two bits (DType::ternary), or Int4Block.
void pack_int8(CodeKind kind, const std::byte* stored, std::int64_t d_in, std::int64_t d_out, std::byte* packed);

/// The shape of a block. few: four rows. rowsN: N rows and N columns on tensor cores.
enum class Int8Shape { few, rows64, rows128 };
/// Steps of the depth in shared memory.
constexpr int int8_stages(CodeKind kind) { return kind == CodeKind::int8 ? 3 : 4; }
inline Launch linear_int8(CodeKind kind, Int8Shape shape, const LinearInt8Job& job) {
  static constexpr const char* kNames[][3] = {{"linear_ternary_few", "linear_ternary_64", "linear_ternary_128"},
                                              {"linear_int4_few", "linear_int4_64", "linear_int4_128"},
                                              {"linear_int8_few", "linear_int8_64", "linear_int8_128"}};
  const char* name = kNames[static_cast<int>(kind)][static_cast<int>(shape)];
  const auto splits = static_cast<unsigned>(job.n_split);
  if (shape == Int8Shape::few)  // four rows; a tile of columns for each of four warps
    return {name, {blocks(job.n_column, 128), blocks(job.n_row, 4), splits}, 128};
  const int size = shape == Int8Shape::rows64 ? 64 : 128;
  return {name,
          {blocks(job.n_column, size), blocks(job.n_row, size), splits},
          128,
          static_cast<unsigned>(int8_stages(kind) * size * (Int8Tile::kDepth + column_bytes(kind)))};
}

/// Tiles of the kernels for Hopper only (hopper_linear_int8.cu): columns, a multiple of 64, and rows, a multiple of 16.
#define VLA_HOPPER_CODE_TILES(each)                                                                                  \
  each(64, 64) each(64, 128) each(128, 64) each(128, 96) each(128, 128) each(128, 160) each(128, 176) each(128, 192) \
      each(128, 224) each(128, 256) each(192, 112) each(192, 160) each(192, 224)
struct HopperInt8Tile {
  const char* kernel;
  CodeKind kind;
  int columns, rows;
};
constexpr HopperInt8Tile kHopperInt8Tiles[] = {
#define VLA_HOPPER_TILE(columns, rows) {"hopper_linear_int8_" #columns "x" #rows, CodeKind::int8, columns, rows},
    VLA_HOPPER_CODE_TILES(VLA_HOPPER_TILE)
#undef VLA_HOPPER_TILE
#define VLA_HOPPER_TILE(columns, rows) {"hopper_linear_ternary_" #columns "x" #rows, CodeKind::ternary, columns, rows},
        VLA_HOPPER_CODE_TILES(VLA_HOPPER_TILE)
#undef VLA_HOPPER_TILE
};
constexpr int kHopperInt8Depth = 128;  // step of the depth, and unit of a split: each share has at least one
/// Stages of rows of x and packed codes in shared memory, where sums follow them, and then 16 bytes for each row.
constexpr int kHopperInt8Stages = 4, kRowOfCodesBytes = 16;
constexpr int hopper_int8_stage_bytes(CodeKind kind, int columns, int rows) {
  return rows * kHopperInt8Depth + columns * column_bytes(kind) * (kHopperInt8Depth / Int8Tile::kDepth);
}
constexpr int hopper_int8_shared(CodeKind kind, int columns, int rows) {
  const int stages = kHopperInt8Stages * hopper_int8_stage_bytes(kind, columns, rows), sums = rows * (columns + 4) * 4;
  return (stages > sums ? stages : sums) + rows * kRowOfCodesBytes;
}
inline Launch hopper_linear_int8(const HopperInt8Tile& tile, const LinearInt8Job& job) {
  return {tile.kernel,
          {blocks(job.n_row, tile.rows), blocks(job.n_column, tile.columns), static_cast<unsigned>(job.n_split)},
          static_cast<unsigned>(tile.columns) * 2,
          static_cast<unsigned>(hopper_int8_shared(tile.kind, tile.columns, tile.rows)),
          cluster_of(job)};
}

inline Launch finish_int8_partial(const LinearInt8Job& job) {
  return {"linear_int8_finish", {blocks(job.n_column, 512), static_cast<unsigned>(job.n_row)}, 128};
}

}  // namespace vla::cuda
