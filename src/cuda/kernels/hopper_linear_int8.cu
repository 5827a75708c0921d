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
  static constexpr int kBytesX = kRows * kSwizzledRow, kPacked = kStage - kBytesX;
  static constexpr int kTerms = hopper_int8_shared(kKind, kColumns, kRows) - kRows * kRowOfCodesBytes;
  static_assert(hopper_int8_shared(kKind, kColumns, kRows) <= static_cast<int>(kHopperShared) && kRows <= kThreads);
  static_assert(sizeof(RowOfCodes) == kRowOfCodesBytes);
};

using Operands = unsigned[2][4];  // of the products of half a step

/// The codes of a step. Each warp copies one tile of the packed matrix to shared memory: warp w the tile of columns
/// w / 2, half w % 2 of the step. In the products it has half w % 2 of the columns of these.
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
  /// Unpacks codes of half a step, which another warp may have copied.
  static VLA_DEVICE void unpack(const std::byte* packed, int half, Operands& to) {
    packed += (warp() / 2 * 2 + half) * kTileBytes<kKind> + lane() * 16;
    if constexpr (kKind == CodeKind::ternary) {
      const auto all = dev::read<uint4>(packed);
      // Bits are chosen, not words: for words the compiler would read the chosen half, whose banks conflict.
      const unsigned second = 0U - static_cast<unsigned>(warp() % 2);
      const unsigned of[2] = {all.x ^ ((all.x ^ all.z) & second), all.y ^ ((all.y ^ all.w) & second)};
#pragma unroll
      for (int i = 0; i < 8; ++i) to[i / 4][i % 4] = ternary_fragment(of[i % 2], i / 2);
    } else {
#pragma unroll
      for (int e = 0; e < 2; ++e) {
        const auto of = dev::read<uint4>(packed + (warp() % 2 * 2 + e) * 512);
        to[0][e] = of.x, to[0][2 + e] = of.y, to[1][e] = of.z, to[1][2 + e] = of.w;
      }
    }
  }

 private:
  static VLA_DEVICE int warp() { return thread_index() / kLanes; }
  static VLA_DEVICE int lane() { return thread_index() % kLanes; }

  const std::byte* from_;
  int n_tile_;  // tiles along the depth
  bool is_there_;
};

template <class T>
VLA_DEVICE void multiply(const LinearInt8Job& job) {
  std::byte *shared = dev::shared_memory(), *packed = shared + T::kStages * T::kBytesX, *terms = shared + T::kTerms;
  const int row0 = static_cast<int>(blockIdx.x) * T::kRows, column0 = static_cast<int>(blockIdx.y) * T::kColumns;
  const int n_step = (job.depth + kHopperInt8Depth - 1) / kHopperInt8Depth, z = static_cast<int>(blockIdx.z);
  const int first = n_step * z / job.n_split, n = n_step * (z + 1) / job.n_split - first;
  const FetchRows<T::kRows, T::kThreads> fetch_x(job.x, job.x_stride, row0, job.n_row, job.depth);
  const Codes<T::kKind> codes(job, column0);

  // A step's codes are copied together with the previous step's x, because they are unpacked a step ahead.
  codes.fetch(packed + (T::kStages - 1) * T::kPacked, first);
  dev::commit_copies();  // commits a group even if it is empty, because waiting counts groups
#pragma unroll
  for (int i = 0; i < T::kStages - 2; ++i)
    if (i + 1 < n) codes.fetch(packed + i * T::kPacked, first + i + 1);
  dev::wait_for_earlier();
#pragma unroll
  for (int i = 0; i < T::kStages - 2; ++i) {
    if (i < n) fetch_x(shared + i * T::kBytesX, first + i);
    dev::commit_copies();
  }
  if (const int row = thread_index(); row < T::kRows && row0 + row < job.n_row)
    dev::write(terms + row * kRowOfCodesBytes, RowOfCodes(job, row0 + row));

  int sum[T::kRows / 2] = {};
  Operands first_half, second_half;
  dev::wait_copies<T::kStages - 2>();
  __syncthreads();  // the first codes are there
  codes.unpack(packed + (T::kStages - 1) * T::kPacked, 0, first_half);
  const std::uint64_t x0 = swizzled_descriptor(shared);
  int stage = 0, next = T::kStages - 2, before = T::kStages - 1;
  int i = 0;
  do {
    dev::wait_copies<T::kStages - 3>();
    dev::fence_async_proxy();
    __syncthreads();  // all warpgroups may multiply the stage, and have multiplied the one that is overwritten next
    const std::uint64_t x = x0 + static_cast<std::uint64_t>(stage * (T::kBytesX / 16));
    const auto multiply_half = [&](int half, const Operands& operands) {
      dev::wgmma_fence();
#pragma unroll
      for (int k = 0; k < 2; ++k) dev::wgmma_s8<T::kRows>(sum, operands[k], x + 4 * half + 2 * k, i + half + k > 0);
      dev::wgmma_commit();
    };
    multiply_half(0, first_half);
    const int ahead = i + T::kStages - 2;
    if (ahead < n) fetch_x(shared + next * T::kBytesX, first + ahead);
    if (ahead + 1 < n) codes.fetch(packed + next * T::kPacked, first + ahead + 1);
    dev::commit_copies();
    dev::wgmma_wait<1>();  // the second half may be unpacked
    codes.unpack(packed + before * T::kPacked, 1, second_half);
    multiply_half(1, second_half);
    dev::wgmma_wait<1>();
    if (i + 1 < n) codes.unpack(packed + stage * T::kPacked, 0, first_half);
    before = stage;
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
  const auto terms_of = [&](int row) { return dev::read<RowOfCodes>(terms + (row - row0) * kRowOfCodesBytes); };
  // Ternary codes are stored plus 1, which adds the row's sum of codes, once in all shares.
  if (job.partial) {
    const bool is_more = T::kKind == CodeKind::ternary && z == 0;
    return end.leave(
        shared, job.partial + static_cast<std::int64_t>(z) * job.n_row * job.n_column, terms_of,
        [&](const RowOfCodes& of, int sum_of) { return static_cast<unsigned>(sum_of - (is_more ? of.sum : 0)); });
  }
  const int column = column0 + thread_index() % (T::kColumns / 4) * 4;
  float scale[4];
  bool are_plain = true;
#pragma unroll
  for (int c = 0; c < 4; ++c) {
    scale[c] = column + c < job.n_column ? job.scale[column + c] : 0;
    are_plain = are_plain && (scale[c] == 0 || is_plain(scale[c]));
  }
  end.finish(
      shared, [&](int row) { return RowRatios(terms_of(row), scale, are_plain); },
      [&](const RowRatios& of, int of_column, int c, bool) {
        return of.scaled(of_column - (T::kKind == CodeKind::ternary ? of.sum : 0), c);
      });
}

}  // namespace

#define VLA_HOPPER_KERNEL(columns, rows)                                                      \
  VLA_EARLY_KERNEL(hopper_linear_int8_##columns##x##rows, columns * 2, 1, LinearInt8Job) {    \
    multiply<Tile<CodeKind::int8, columns, rows>>(job);                                       \
  }                                                                                           \
  VLA_EARLY_KERNEL(hopper_linear_ternary_##columns##x##rows, columns * 2, 1, LinearInt8Job) { \
    multiply<Tile<CodeKind::ternary, columns, rows>>(job);                                    \
  }
VLA_HOPPER_CODE_TILES(VLA_HOPPER_KERNEL)
#undef VLA_HOPPER_KERNEL

}  // namespace vla::cuda
