// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/kernels/epilogue.h"
#include "cuda/kernels/launch.h"

/// Products of int8 rows and a matrix of ternary or int8 codes: exact sums, then float(sum) * (scale of the column /
/// scale of the row) and the epilogue. Every operation is rounded separately, as in the kernels for CPUs
/// (kernels/quantized.h).
namespace vla::cuda {

/// Rows of codes lie as kernels/quantized.h says: the depth in zeros up to a multiple of 64, then 64 bytes that begin
/// with the row's scale (float) and the sum of its codes (int).
///
/// A packed matrix is tiles of 32 columns and 64 of the depth, along the depth first. Lane l of a warp owns column
/// l / 4 of every eight, and of fragment s (0 to 3) the depth 16 s + 4 (l % 4) + b for byte b of a register.
/// int8: 2048 bytes a tile; 16 bytes for every eight columns and lane, the registers of its four fragments.
/// ternary: 512 bytes; a word for every eight columns, 16 bytes of each lane. Byte b of it has a code plus 1 in two
/// bits for each fragment, the first in the lowest, so that a shift by 2 s and a mask make the register. The 1 adds the
/// row's sum of codes to every product, and comes off at the end.
struct Int8Tile {
  static constexpr int kColumns = 32, kDepth = 64;
  static constexpr int kBytes = kColumns * kDepth, kTernaryBytes = kBytes / 4;
};

struct LinearInt8Job {
  const std::byte* x;  // n_row rows of codes
  const std::byte* weight;
  const float* scale;  // [n_column]
  std::int64_t x_stride;
  int n_row, n_column, depth;  // a multiple of 64
  /// With more than one split, sums over a share of the depth go to partial [n_column, n_row, n_split];
  /// `finish_int8_partial` computes y from them. Sums are integers, so the bits stay the same.
  int n_split;
  int* partial;
  Epilogue end;
};

enum class CodeKind { ternary, int8 };

/// Bytes of a packed matrix.
std::size_t packed_int8_size(CodeKind kind, std::int64_t d_in, std::int64_t d_out);
/// stored: d_out rows of d_in elements as in a bundle: int8, or ternary in two bits (DType::ternary).
void pack_int8(CodeKind kind, const std::byte* stored, std::int64_t d_in, std::int64_t d_out, std::byte* packed);

/// Rows of a block on tensor cores.
enum class Int8Shape { few, rows64, rows128 };
inline Launch linear_int8(CodeKind kind, Int8Shape shape, const LinearInt8Job& job) {
  const bool ternary = kind == CodeKind::ternary;
  const auto splits = static_cast<unsigned>(job.n_split);
  if (shape == Int8Shape::few)  // four rows; a tile of columns for each of four warps
    return {ternary ? "linear_ternary_few" : "linear_int8_few",
            {blocks(job.n_column, 128), blocks(job.n_row, 4), splits},
            128};
  const unsigned size = shape == Int8Shape::rows64 ? 64 : 128, n_stage = ternary ? 4 : 3;
  const char* name = shape == Int8Shape::rows64 ? (ternary ? "linear_ternary_64" : "linear_int8_64")
                                                : (ternary ? "linear_ternary_128" : "linear_int8_128");
  return {name,
          {blocks(job.n_column, size), blocks(job.n_row, size), splits},
          128,
          n_stage * size * (Int8Tile::kDepth + (ternary ? 16 : 64))};
}
inline Launch finish_int8_partial(const LinearInt8Job& job) {
  return {"linear_int8_finish", {blocks(job.n_column, 256), static_cast<unsigned>(job.n_row)}, 128};
}

}  // namespace vla::cuda
