// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/linear_int8.h"

#include "cuda/kernels/finish.h"
#include "cuda/kernels/packed_codes.h"
#include "cuda/kernels/row_scale.h"
#include "cuda/kernels/store_sums.h"

namespace vla::cuda {
namespace {

constexpr int kDepth = Int8Tile::kDepth;

/// Stores two adjacent sums: the sums themselves if the depth is split, else y. The first share of the depth subtracts
/// the offset of ternary codes.
template <CodeKind kKind>
VLA_DEVICE void store_pair(const LinearInt8Job& job, const RowScale& of_row, int first, int second, int row,
                           int column) {
  const bool has_second = column + 1 < job.n_column;
  const int offset = kKind == CodeKind::ternary && blockIdx.z == 0 ? of_row.sum : 0;
  first -= offset, second -= offset;
  if (job.n_split > 1) {
    int* to = job.partial + (static_cast<std::int64_t>(blockIdx.z) * job.n_row + row) * job.n_column + column;
    to[0] = first;
    if (has_second) to[1] = second;
    return;
  }
  finish_pair(job.end, of_row.scaled(first, job.scale[column]),
              has_second ? of_row.scaled(second, job.scale[column + 1]) : 0, row, column, job.n_column);
}

/// The steps of the depth that block z of a split computes.
struct Share {
  int first, end;
  VLA_DEVICE explicit Share(const LinearInt8Job& job) {
    const int n_step = job.depth / kDepth, z = static_cast<int>(blockIdx.z);
    first = n_step * z / job.n_split, end = n_step * (z + 1) / job.n_split;
  }
};

// On tensor cores

/// Four warps in a 2 x 2 grid. Each computes kTilesM x kTilesN products of 16 x 8. Shared memory holds kStages steps of
/// the depth.
template <CodeKind kKind_, int kTilesM_, int kTilesN_>
struct Shape {
  static constexpr CodeKind kKind = kKind_;
  static constexpr int kTilesM = kTilesM_, kTilesN = kTilesN_, kThreads = 128;
  static constexpr int kStages = int8_stages(kKind);
  static constexpr int kRows = 2 * kTilesM * 16, kColumns = 2 * kTilesN * 8;
  static constexpr int kBytesX = kRows * kDepth, kBytesW = kColumns * column_bytes(kKind), kStage = kBytesX + kBytesW;
};

/// Offset of 16 bytes of a row of x in a stage. The eight rows of a matrix load are in different banks.
VLA_DEVICE int x_place(int row, int chunk) { return row * kDepth + (chunk ^ (row >> 1 & 3)) * 16; }

/// Copies a step of the depth to a stage.
template <class S>
VLA_DEVICE void fetch(const LinearInt8Job& job, int row0, int column0, int step, std::byte* stage) {
  const int thread = thread_index();
#pragma unroll
  for (int i = 0; i < S::kRows; i += S::kThreads / 4) {
    const int row = i + thread / 4, chunk = thread % 4;
    const bool valid = row0 + row < job.n_row;
    const std::byte* from = job.x + (valid ? row0 + row : 0) * job.x_stride + step * kDepth + chunk * 16;
    dev::copy_async(stage + x_place(row, chunk), from, valid ? 16 : 0);
  }
  const int n_tile = (job.n_column + Int8Tile::kColumns - 1) / Int8Tile::kColumns;
#pragma unroll
  for (int i = 0; i < S::kBytesW; i += S::kThreads * 16) {
    const int at = i + thread * 16, tile = column0 / Int8Tile::kColumns + at / kTileBytes<S::kKind>;
    if (S::kBytesW % (S::kThreads * 16) != 0 && at >= S::kBytesW) break;
    const bool valid = tile < n_tile;
    const std::int64_t first =
        (static_cast<std::int64_t>(valid ? tile : 0) * (job.depth / kDepth) + step) * kTileBytes<S::kKind>;
    dev::copy_async(stage + S::kBytesX + at, job.weight + first + at % kTileBytes<S::kKind>, valid ? 16 : 0);
  }
}

/// Multiplies a stage in two steps of 32 of the depth.
template <class S>
VLA_DEVICE void multiply_stage(const std::byte* stage, int warp_row, int warp_column,
                               int (&sum)[S::kTilesM][S::kTilesN][4]) {
  const int lane = thread_index() % kLanes;
  LaneCodes<S::kKind> codes[S::kTilesN / 4];
#pragma unroll
  for (int i = 0; i < S::kTilesN / 4; ++i) {
    const std::byte* w = stage + S::kBytesX + (warp_column / Int8Tile::kColumns + i) * kTileBytes<S::kKind>;
    codes[i] = LaneCodes<S::kKind>([&](auto type, int at) { return dev::read<decltype(type)>(w + at); });
  }
#pragma unroll
  for (int half = 0; half < 2; ++half) {
    unsigned a[S::kTilesM][4];
#pragma unroll
    for (int m = 0; m < S::kTilesM; ++m)
      dev::load_matrices(a[m], stage + x_place(warp_row + m * 16 + lane % 16, half * 2 + lane / 16));
#pragma unroll
    for (int n = 0; n < S::kTilesN; ++n) {
      const LaneCodes<S::kKind>& of = codes[n / 4];
      const unsigned b0 = of.fragment(n % 4, half * 2), b1 = of.fragment(n % 4, half * 2 + 1);
#pragma unroll
      for (int m = 0; m < S::kTilesM; ++m) dev::multiply_s8(sum[m][n], a[m], b0, b1);
    }
  }
}

template <class S>
VLA_DEVICE void multiply(const LinearInt8Job& job) {
  dev::wait_for_earlier();
  std::byte* shared = dev::shared_memory();
  const int warp = thread_index() / kLanes;
  const int warp_row = warp % 2 * S::kTilesM * 16, warp_column = warp / 2 * S::kTilesN * 8;
  const int row0 = static_cast<int>(blockIdx.y) * S::kRows, column0 = static_cast<int>(blockIdx.x) * S::kColumns;
  const Share share(job);

  int sum[S::kTilesM][S::kTilesN][4] = {};
#pragma unroll
  for (int i = 0; i < S::kStages - 1; ++i) {
    if (share.first + i < share.end) fetch<S>(job, row0, column0, share.first + i, shared + i * S::kStage);
    dev::commit_copies();  // commits a group even if it is empty, because waiting counts groups
  }
  int stage = 0, next = S::kStages - 1;
  for (int step = share.first; step < share.end; ++step) {
    dev::wait_copies<S::kStages - 2>();
    __syncthreads();  // the stage is visible to all threads, and all have read the stage that is overwritten next
    if (step + S::kStages - 1 < share.end)
      fetch<S>(job, row0, column0, step + S::kStages - 1, shared + next * S::kStage);
    dev::commit_copies();
    multiply_stage<S>(shared + stage * S::kStage, warp_row, warp_column, sum);
    stage = stage + 1 == S::kStages ? 0 : stage + 1;
    next = next + 1 == S::kStages ? 0 : next + 1;
  }

  dev::let_next_begin();
  dev::wait_copies<0>();
  __syncthreads();  // the stages' memory is reused for sums
  store_sums(sum, shared + warp * kSumBytes<S::kTilesN>, [&](int row, int column, int first, int second) {
    row += row0 + warp_row, column += column0 + warp_column;
    if (row < job.n_row && column < job.n_column)
      store_pair<S::kKind>(job, RowScale(job, row), first, second, row, column);
  });
}

// For few rows, four bytes at a time: reading the matrix once is the bottleneck

constexpr int kFewRows = 4;

/// A warp computes a tile of columns; each lane sums a quarter of the depth for four of them.
template <CodeKind kKind>
VLA_DEVICE void multiply_few(const LinearInt8Job& job) {
  const int lane = thread_index() % kLanes, tile = static_cast<int>(blockIdx.x) * 4 + thread_index() / kLanes;
  const int row0 = static_cast<int>(blockIdx.y) * kFewRows;
  if (tile * Int8Tile::kColumns >= job.n_column) return;  // the whole warp
  const std::byte* w = job.weight + static_cast<std::int64_t>(tile) * (job.depth / kDepth) * kTileBytes<kKind>;
  const Share share(job);
  int sum[kFewRows][4] = {};
  for (int step = share.first; step < share.end; ++step) {
    const std::byte* of_step = w + static_cast<std::int64_t>(step) * kTileBytes<kKind>;
    const LaneCodes<kKind> codes(
        [&](auto type, int at) { return *reinterpret_cast<const decltype(type)*>(of_step + at); });
#pragma unroll
    for (int r = 0; r < kFewRows; ++r) {
      if (row0 + r >= job.n_row) break;
      const std::byte* x = job.x + (row0 + r) * job.x_stride + step * kDepth + lane % 4 * 4;
#pragma unroll
      for (int s = 0; s < 4; ++s) {
        const unsigned four = *reinterpret_cast<const unsigned*>(x + 16 * s);
#pragma unroll
        for (int j = 0; j < 4; ++j) sum[r][j] = dev::dot4(four, codes.fragment(j, s), sum[r][j]);
      }
    }
  }
#pragma unroll
  for (int r = 0; r < kFewRows; ++r) {
    int first = 0, second = 0;  // each of the four lanes that share columns stores another pair
#pragma unroll
    for (int j = 0; j < 4; ++j) {
      int total = sum[r][j];
      total += dev::shuffle_xor(total, 1);
      total += dev::shuffle_xor(total, 2);
      const int beside = dev::shuffle_xor(total, 4);  // sum of the next column
      if (lane % 4 == j) first = total, second = beside;
    }
    const int row = row0 + r, column = tile * Int8Tile::kColumns + lane % 4 * 8 + lane / 4;
    if (lane % 8 < 4 && row < job.n_row && column < job.n_column)
      store_pair<kKind>(job, RowScale(job, row), first, second, row, column);
  }
}

}  // namespace

using Ternary128 = Shape<CodeKind::ternary, 4, 8>;
using Ternary64 = Shape<CodeKind::ternary, 2, 4>;
using Nibbles128 = Shape<CodeKind::int4, 4, 8>;
using Nibbles64 = Shape<CodeKind::int4, 2, 4>;
using Bytes128 = Shape<CodeKind::int8, 4, 8>;
using Bytes64 = Shape<CodeKind::int8, 2, 4>;

VLA_EARLY_KERNEL(linear_ternary_128, 128, 2, LinearInt8Job) { multiply<Ternary128>(job); }
VLA_EARLY_KERNEL(linear_ternary_64, 128, 4, LinearInt8Job) { multiply<Ternary64>(job); }
VLA_EARLY_KERNEL(linear_int4_128, 128, 2, LinearInt8Job) { multiply<Nibbles128>(job); }
VLA_EARLY_KERNEL(linear_int4_64, 128, 4, LinearInt8Job) { multiply<Nibbles64>(job); }
VLA_EARLY_KERNEL(linear_int8_128, 128, 2, LinearInt8Job) { multiply<Bytes128>(job); }
VLA_EARLY_KERNEL(linear_int8_64, 128, 4, LinearInt8Job) { multiply<Bytes64>(job); }
VLA_KERNEL(linear_ternary_few, 128, 4, LinearInt8Job) { multiply_few<CodeKind::ternary>(job); }
VLA_KERNEL(linear_int4_few, 128, 4, LinearInt8Job) { multiply_few<CodeKind::int4>(job); }
VLA_KERNEL(linear_int8_few, 128, 4, LinearInt8Job) { multiply_few<CodeKind::int8>(job); }

namespace {

/// Adds four adjacent sums over all shares of the depth; the first n exist. kTogether: all four exist and are aligned,
/// and there are at most kMostSplits shares, loaded at once.
template <bool kTogether>
VLA_DEVICE void add_shares(const LinearInt8Job& job, int row, int column, int n, int (&sum)[4]) {
  const std::int64_t apart = static_cast<std::int64_t>(job.n_row) * job.n_column;
  const int* from = job.partial + static_cast<std::int64_t>(row) * job.n_column + column;
  if constexpr (kTogether) {
    uint4 share[kMostSplits];
#pragma unroll
    for (int z = 0; z < kMostSplits; ++z)
      share[z] = z < job.n_split ? *reinterpret_cast<const uint4*>(from + z * apart) : uint4{0, 0, 0, 0};
#pragma unroll
    for (int z = 0; z < kMostSplits; ++z) {
      const unsigned four[4] = {share[z].x, share[z].y, share[z].z, share[z].w};
#pragma unroll
      for (int c = 0; c < 4; ++c) sum[c] += static_cast<int>(four[c]);
    }
  } else {
#pragma unroll 1
    for (int z = 0; z < job.n_split; ++z, from += apart)
#pragma unroll
      for (int c = 0; c < 4; ++c)
        if (c < n) sum[c] += from[c];
  }
}

template <bool kTogether>
VLA_DEVICE void finish_four(const LinearInt8Job& job, int row, int column) {
  const int n = job.n_column - column;
  int sum[4] = {};
  add_shares<kTogether>(job, row, column, n, sum);
  const Four scale = load_four(job.scale + column, kTogether, n);
  bool are_plain = true;
#pragma unroll
  for (int c = 0; c < 4; ++c) are_plain = are_plain && (scale.of[c] == 0 || is_plain(scale.of[c]));
  const RowRatios of(RowOfCodes(job, row), scale.of, are_plain);
  Four scaled, gate = {};
#pragma unroll
  for (int c = 0; c < 4; ++c) scaled.of[c] = of.scaled(sum[c], c);
  const std::int64_t at = static_cast<std::int64_t>(row) * job.n_column + column;
  if (job.end.gate) gate = load_four(job.end.gate + at, kTogether, n);
  finish_four<kTogether>(job.end, row, column, job.n_column, scaled, job.end.gate != nullptr, gate);
}

}  // namespace

/// Adds the partial sums of a split and computes y.
VLA_KERNEL(linear_int8_finish, 128, 4, LinearInt8Job) {
  const int row = static_cast<int>(blockIdx.y), column = (static_cast<int>(blockIdx.x) * 128 + thread_index()) * 4;
  if (column >= job.n_column) return;
  const auto others = reinterpret_cast<std::uint64_t>(job.scale) | reinterpret_cast<std::uint64_t>(job.partial);
  if (is_of_fours(job.end, job.n_column) && others % 16 == 0 && job.n_split <= kMostSplits)
    finish_four<true>(job, row, column);
  else
    finish_four<false>(job, row, column);
}

}  // namespace vla::cuda
