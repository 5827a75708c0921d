// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/share.h"

namespace vla::cuda {
namespace {

constexpr int kWarps = 8, kThreads = kWarps * kLanes, kStripRows = 64, kTilesM = kStripRows / 16;

/// A block computes sums of up to 64 rows and kColumns columns, half of them the gate's if there is a gate. A warp has
/// kTilesN * 8 of the columns; warps with the same columns take the steps of the depth in turn.
template <int kTilesN_, int kWarpsN_, bool kGated_>
struct Strip {
  static constexpr int kTilesN = kTilesN_, kWarpsN = kWarpsN_, kWarpsK = kWarps / kWarpsN;
  static constexpr bool kGated = kGated_;
  static constexpr int kColumns = kTilesN * 8 * kWarpsN;
  static constexpr int kColumnsY = kGated ? kColumns / 2 : kColumns;
  // Steps that a warp loads ahead: all of a depth of 768 where registers suffice.
  static constexpr int kAhead = kTilesN == 2 || (kGated && kWarpsN == 1) ? 3 : 2;
  static constexpr int kRowBytes = (kColumns + 8) * 4;  // a row of sums in shared memory, padded against bank conflicts
};

/// A lane's operands of a step: 16 bytes, eight elements, of each of its rows and columns. The order of the depth is
/// free, so elements stay in memory order: the first four enter one product of 16, the other four the next.
template <class S>
class Operands {
 public:
  /// Finds the addresses for a warp: all rows of the block, and the columns from column of_warp of the block on.
  VLA_DEVICE Operands(const LinearBf16Job& job, int row0, int column0, int of_warp)
      : x_(static_cast<const std::byte*>(job.x) + row0 * job.x_stride * 2), n_chunk_(job.depth / 8) {
    const int lane = thread_index() % kLanes;
    // Rows and columns after the last one read the last one; their sums are not stored.
    const auto nearest = [](int i, int n) { return i < n ? i : n - 1; };
#pragma unroll
    for (int r = 0; r < 2 * kTilesM; ++r)
      x_place_[r] = static_cast<unsigned>((nearest(row0 + r * 8 + lane / 4, job.n_row) - row0) * job.x_stride * 2);
#pragma unroll
    for (int n = 0; n < S::kTilesN; ++n) {
      const int column = of_warp + n * 8;
      const bool is_gate = S::kGated && column < S::kColumnsY;
      const int of = column0 + (S::kGated && !is_gate ? column - S::kColumnsY : column) + lane / 4;
      weight_[n] = reinterpret_cast<const std::byte*>(is_gate ? job.gate_weight : job.weight) +
                   nearest(of, job.n_column) * job.weight_stride * 2;
    }
  }

  struct Step {
    uint4 x[2 * kTilesM], weight[S::kTilesN];

    VLA_DEVICE void multiply(float (&sum)[kTilesM][S::kTilesN][4]) const {
#pragma unroll
      for (int m = 0; m < kTilesM; ++m) {
        const uint4 low = x[2 * m], high = x[2 * m + 1];
        const unsigned first[4] = {low.x, high.x, low.y, high.y}, second[4] = {low.z, high.z, low.w, high.w};
#pragma unroll
        for (int n = 0; n < S::kTilesN; ++n) {
          dev::multiply_bf16(sum[m][n], first, weight[n].x, weight[n].y);
          dev::multiply_bf16(sum[m][n], second, weight[n].z, weight[n].w);
        }
      }
    }
  };
  /// After the depth, weights are zeros, and x is read from its beginning.
  VLA_DEVICE void load_weight(Step& to, int step) const {
    const int chunk = chunk_of(step);
#pragma unroll
    for (int n = 0; n < S::kTilesN; ++n)
      to.weight[n] = chunk < n_chunk_ ? *reinterpret_cast<const uint4*>(weight_[n] + chunk * 16) : uint4{0, 0, 0, 0};
  }
  VLA_DEVICE void load_x(Step& to, int step) const {
    const int chunk = chunk_of(step) < n_chunk_ ? chunk_of(step) : 0;
#pragma unroll
    for (int r = 0; r < 2 * kTilesM; ++r) to.x[r] = *reinterpret_cast<const uint4*>(x_ + x_place_[r] + chunk * 16);
  }

 private:
  static VLA_DEVICE int chunk_of(int step) { return step * (kBf16Depth / 8) + thread_index() % 4; }

  const std::byte *x_, *weight_[S::kTilesN];
  unsigned x_place_[2 * kTilesM];
  int n_chunk_;
};

/// Adds the sums of warps that share columns, in their order, and stores pairs of y.
template <class S>
VLA_DEVICE void add_and_store(const LinearBf16Job& job, int row0, int column0) {
  constexpr int kPairs = S::kColumnsY / 2, kOf = kStripRows * S::kRowBytes, kEach = kStripRows * kPairs / kThreads;
  constexpr int kApart = kThreads / kPairs;  // distance between two rows of a thread
  const int number = thread_index() / kPairs, of_block = thread_index() % kPairs * 2, column = column0 + of_block;
  // If a transaction reads two or four rows, this order puts them in different banks.
  const int first_row = kPairs == 8 ? (number & ~3) + number % 2 * 2 + number / 2 % 2 : number;
  const auto valid = [&](int row) { return row0 + row < job.n_row && column < job.n_column; };
  const auto add = [&](int row, int at) {
    float2 sum = {0, 0};
#pragma unroll
    for (int w = 0; w < S::kWarpsK; ++w) {
      const auto pair = dev::read<float2>(dev::shared_memory() + w * kOf + row * S::kRowBytes + at * 4);
      sum.x += pair.x, sum.y += pair.y;
    }
    return sum;
  };
  PairEnds ends[kEach];
#pragma unroll
  for (int i = 0; i < kEach; ++i)
    if (job.n_split == 1 && valid(first_row + i * kApart))
      ends[i] = load_ends(job.end, row0 + first_row + i * kApart, column, job.n_column);
  __syncthreads();  // sums of all warps are there
#pragma unroll
  for (int i = 0; i < kEach; ++i) {
    const int row = first_row + i * kApart;
    const float2 gate = S::kGated ? add(row, of_block) : float2{0, 0};
    const float2 sum = add(row, S::kColumns - S::kColumnsY + of_block);
    if (!valid(row)) continue;
    if (job.n_split > 1) {
      const bool has_second = column + 1 < job.n_column;
      if (S::kGated) store_partial(job, gate.x, gate.y, row0 + row, column, has_second);
      store_partial(job, sum.x, sum.y, row0 + row, job.n_sum() - job.n_column + column, has_second);
      continue;
    }
    if (S::kGated) {
      ends[i].gate = gate, ends[i].has_gate = true;
      add_gate_bias(job, ends[i], column);
    }
    finish_pair(job.end, ends[i], sum.x, sum.y, row0 + row, column);
  }
}

template <class S>
VLA_DEVICE void multiply_strip(const LinearBf16Job& job, int block) {
  const int warp = thread_index() / kLanes, lane = thread_index() % kLanes;
  const int row0 = static_cast<int>(blockIdx.y) * kStripRows, column0 = block * S::kColumnsY;
  const int of_warp = warp % S::kWarpsN * S::kTilesN * 8, of_k = warp / S::kWarpsN;
  const Share share(job);
  const Operands<S> operands(job, row0, column0, of_warp);

  typename Operands<S>::Step ahead[S::kAhead];
  const int first = share.first + of_k;
#pragma unroll
  for (int i = 0; i < S::kAhead; ++i) operands.load_weight(ahead[i], first + i * S::kWarpsK);
  dev::wait_for_earlier();
#pragma unroll
  for (int i = 0; i < S::kAhead; ++i) operands.load_x(ahead[i], first + i * S::kWarpsK);
  float sum[kTilesM][S::kTilesN][4] = {};
#pragma unroll 1
  for (int step = first; step < share.end; step += S::kAhead * S::kWarpsK) {
#pragma unroll
    for (int i = 0; i < S::kAhead; ++i) {
      const int now = step + i * S::kWarpsK, next = now + S::kAhead * S::kWarpsK;
      if (now < share.end) ahead[i].multiply(sum);
      if (next < share.end) operands.load_weight(ahead[i], next), operands.load_x(ahead[i], next);
    }
  }

  dev::let_next_begin();
  std::byte* room = dev::shared_memory() + of_k * kStripRows * S::kRowBytes;
#pragma unroll
  for (int m = 0; m < kTilesM; ++m)
#pragma unroll
    for (int n = 0; n < S::kTilesN; ++n)
#pragma unroll
      for (int high = 0; high < 2; ++high)
        dev::write(room + (m * 16 + high * 8 + lane / 4) * S::kRowBytes + (of_warp + n * 8 + lane % 4 * 2) * 4,
                   float2{sum[m][n][2 * high], sum[m][n][2 * high + 1]});
  add_and_store<S>(job, row0, column0);
}

}  // namespace

#define VLA_STRIP(name, ...)                                               \
  VLA_EARLY_KERNEL(linear_strip_##name, 256, 1, LinearBf16Job) {           \
    multiply_strip<Strip<__VA_ARGS__>>(job, static_cast<int>(blockIdx.x)); \
  }
#define VLA_STRIPS(name, ...)                                                                             \
  VLA_EARLY_KERNEL(linear_strips_##name, 256, 1, Several<LinearBf16Job>) {                                \
    run_one(job, blockIdx.x,                                                                              \
            [](const LinearBf16Job& one, int block) { multiply_strip<Strip<__VA_ARGS__>>(one, block); }); \
  }
VLA_STRIP(16, 2, 1, false)
VLA_STRIP(32, 4, 1, false)
VLA_STRIP(64, 4, 2, false)
VLA_STRIP(128, 4, 4, false)
VLA_STRIP(16_gated, 2, 1, true)
VLA_STRIP(32_gated, 4, 1, true)
VLA_STRIP(64_gated, 4, 2, true)
VLA_STRIP(128_gated, 4, 4, true)
VLA_STRIPS(16, 2, 1, false)
VLA_STRIPS(32, 4, 1, false)
VLA_STRIPS(64, 4, 2, false)
#undef VLA_STRIP
#undef VLA_STRIPS

}  // namespace vla::cuda
