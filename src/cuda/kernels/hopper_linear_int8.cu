// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/hopper_tile.h"
#include "cuda/kernels/packed_codes.h"
#include "cuda/kernels/row_scale.h"

namespace vla::cuda {
namespace {

template <CodeKind kKind_, int kColumns_, int kRows_>
struct Tile {
  static constexpr CodeKind kKind = kKind_;
  static constexpr int kColumns = kColumns_, kRows = kRows_, kThreads = kColumns * 2;
  static constexpr int kStages = kHopperInt8Stages, kStage = hopper_int8_stage_bytes(kKind, kColumns, kRows);
  static constexpr int kBytesX = kRows * kSwizzledRow, kBytesW = kColumns * kSwizzledRow;
  static_assert(hopper_int8_shared(kKind, kColumns, kRows) <= static_cast<int>(kHopperShared));
};

/// The codes of a step. Each warp copies one tile of the packed matrix to shared memory: warp w the tile of columns
/// w / 2, half w % 2 of the step. It unpacks the tile to rows of bytes, as wgmma reads them. A word of a lane has four
/// elements along the depth of one of its columns, so a warp writes to all banks.
template <CodeKind kKind>
class Codes {
 public:
  VLA_DEVICE Codes(const LinearInt8Job& job, int column0) : n_tile_(job.depth / Int8Tile::kDepth) {
    const int tile = column0 / Int8Tile::kColumns + warp() / 2,
              n = (job.n_column + Int8Tile::kColumns - 1) / Int8Tile::kColumns;
    is_there_ = tile < n;
    from_ = job.weight + static_cast<std::int64_t>(is_there_ ? tile : 0) * n_tile_ * kTileBytes<kKind> + lane() * 16;
  }
  VLA_DEVICE void fetch(std::byte* packed, int step) const {
    const int tile = step * 2 + warp() % 2;
    const bool valid = is_there_ && tile < n_tile_;
    const std::byte* from = from_ + static_cast<std::int64_t>(valid ? tile : 0) * kTileBytes<kKind>;
#pragma unroll
    for (int i = 0; i < kTileBytes<kKind>; i += 512)
      dev::copy_async(packed + warp() * kTileBytes<kKind> + i + lane() * 16, from + i, valid ? 16 : 0);
  }
  /// Each thread reads only the bytes that it copied itself.
  VLA_DEVICE void unpack(const std::byte* packed, std::byte* rows) const {
    packed += warp() * kTileBytes<kKind>;
    const LaneCodes<kKind> codes([&](auto type, int at) { return dev::read<decltype(type)>(packed + at); });
#pragma unroll
    for (int eight = 0; eight < 4; ++eight)
#pragma unroll
      for (int i = 0; i < 4; ++i) write(rows, eight, i, codes.fragment(eight, i));
  }

 private:
  static VLA_DEVICE int warp() { return thread_index() / kLanes; }
  static VLA_DEVICE int lane() { return thread_index() % kLanes; }
  static VLA_DEVICE void write(std::byte* rows, int eight, int fragment, unsigned word) {
    const int column = warp() / 2 * Int8Tile::kColumns + eight * 8 + lane() / 4;
    dev::write(rows + swizzled(column, warp() % 2 * 4 + fragment) + lane() % 4 * 4, word);
  }

  const std::byte* from_;
  int n_tile_;  // tiles along the depth
  bool is_there_;
};

template <class T>
VLA_DEVICE void multiply(const LinearInt8Job& job) {
  std::byte *shared = dev::shared_memory(), *rows_w = shared + T::kStages * T::kBytesX;
  std::byte* packed = rows_w + kHopperCodeStages * T::kBytesW;
  constexpr int kPacked = T::kStage - T::kBytesX;
  const int row0 = static_cast<int>(blockIdx.x) * T::kRows, column0 = static_cast<int>(blockIdx.y) * T::kColumns;
  const int n_step = (job.depth + kHopperInt8Depth - 1) / kHopperInt8Depth, z = static_cast<int>(blockIdx.z);
  const int first = n_step * z / job.n_split, n = n_step * (z + 1) / job.n_split - first;
  const FetchRows<T::kRows, T::kThreads> fetch_x(job.x, job.x_stride, row0, job.n_row, job.depth);
  const Codes<T::kKind> codes(job, column0);

  // A step's codes are copied together with the previous step's x, because they are unpacked a step ahead.
  codes.fetch(packed + (T::kStages - 1) * kPacked, first);
  dev::commit_copies();  // commits a group even if it is empty, because waiting counts groups
#pragma unroll
  for (int i = 0; i < T::kStages - 2; ++i)
    if (i + 1 < n) codes.fetch(packed + i * kPacked, first + i + 1);
  dev::wait_for_earlier();
#pragma unroll
  for (int i = 0; i < T::kStages - 2; ++i) {
    if (i < n) fetch_x(shared + i * T::kBytesX, first + i);
    dev::commit_copies();
  }
  dev::wait_copies<T::kStages - 2>();
  codes.unpack(packed + (T::kStages - 1) * kPacked, rows_w);

  int sum[T::kRows / 2] = {};
  const std::uint64_t x0 = swizzled_descriptor(shared);
  const std::uint64_t w0 = swizzled_descriptor(rows_w + thread_index() / 128 * 64 * kSwizzledRow);
  int stage = 0, next = T::kStages - 2, stage_w = 0;
  int i = 0;
  do {
    dev::wait_copies<T::kStages - 3>();
    dev::fence_async_proxy();
    __syncthreads();  // all warpgroups may multiply the stage, and have multiplied the one that is overwritten next
    const std::uint64_t x = x0 + static_cast<std::uint64_t>(stage * (T::kBytesX / 16));
    const std::uint64_t w = w0 + static_cast<std::uint64_t>(stage_w * (T::kBytesW / 16));
    dev::wgmma_fence();
#pragma unroll
    for (int k = 0; k < 4; ++k) dev::wgmma_s8<T::kRows>(sum, w + 2 * k, x + 2 * k, i + k > 0);
    dev::wgmma_commit();
    stage_w = stage_w + 1 == kHopperCodeStages ? 0 : stage_w + 1;
    const int ahead = i + T::kStages - 2;
    if (ahead < n) fetch_x(shared + next * T::kBytesX, first + ahead);
    if (ahead + 1 < n) codes.fetch(packed + next * kPacked, first + ahead + 1);
    dev::commit_copies();
    if (i + 1 < n) codes.unpack(packed + stage * kPacked, rows_w + stage_w * T::kBytesW);
    dev::wgmma_wait<1>();
    stage = stage + 1 == T::kStages ? 0 : stage + 1;
    next = next + 1 == T::kStages ? 0 : next + 1;
  } while (++i < n);

  dev::let_next_begin();
  dev::wgmma_wait_all(sum);
  dev::wait_copies<0>();
  __syncthreads();  // the stages' memory is reused for sums
  using End = TileEnd<int, T::kColumns, T::kRows, false>;
  End::place(sum, shared);
  const End end(job, nullptr, job.n_row, row0, column0);
  // Ternary codes are stored plus 1, which adds the row's sum of codes, once in all shares.
  if (job.partial)
    return end.leave(
        shared, job.partial + static_cast<std::int64_t>(z) * job.n_row * job.n_column,
        [&](int row) { return RowScale(job, row); },
        [&](const RowScale& of, int of_column) {
          return static_cast<unsigned>(of_column - (T::kKind == CodeKind::ternary && z == 0 ? of.sum : 0));
        });
  const int column = column0 + thread_index() % (T::kColumns / 4) * 4;
  float scale[4];
  bool are_plain = true;
#pragma unroll
  for (int c = 0; c < 4; ++c) {
    scale[c] = column + c < job.n_column ? job.scale[column + c] : 0;
    are_plain = are_plain && (scale[c] == 0 || is_plain(scale[c]));
  }
  end.finish(
      shared, [&](int row) { return RowRatios(job, row, scale, are_plain); },
      [&](const RowRatios& of, int of_column, int c, bool) {
        return of.scaled(of_column - (T::kKind == CodeKind::ternary ? of.sum : 0), c);
      });
}

}  // namespace

#define VLA_HOPPER_KERNEL(columns, rows)                                                   \
  VLA_EARLY_KERNEL(hopper_linear_int8_##columns##x##rows, columns * 2, 1, LinearInt8Job) { \
    multiply<Tile<CodeKind::int8, columns, rows>>(job);                                    \
  }
VLA_HOPPER_INT8_TILES(VLA_HOPPER_KERNEL)
#undef VLA_HOPPER_KERNEL
#define VLA_HOPPER_KERNEL(columns, rows)                                                      \
  VLA_EARLY_KERNEL(hopper_linear_ternary_##columns##x##rows, columns * 2, 1, LinearInt8Job) { \
    multiply<Tile<CodeKind::ternary, columns, rows>>(job);                                    \
  }
VLA_HOPPER_TERNARY_TILES(VLA_HOPPER_KERNEL)
#undef VLA_HOPPER_KERNEL

}  // namespace vla::cuda
