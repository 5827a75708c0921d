// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/kernels/device.h"

namespace vla::cuda {

/// Byte offset of a warp's sum in shared memory. Rows are padded by 8 elements against bank conflicts.
template <int kTilesN>
VLA_DEVICE int sum_place(int row, int column) {
  return (row * (kTilesN * 8 + 8) + column) * 4;
}
/// Bytes of shared memory per warp.
template <int kTilesN>
constexpr int kSumBytes = 16 * (kTilesN * 8 + 8) * 4;

/// Calls store(row, column, first, second) for pairs of a warp's sums, 16 rows at a time, with adjacent columns in
/// adjacent lanes. The sums pass through shared memory, which makes stores coalesced and the epilogue's code short.
/// `room` belongs to the warp; T has 4 bytes.
template <int kTilesM, int kTilesN, class T, class Store>
VLA_DEVICE void store_sums(const T (&sum)[kTilesM][kTilesN][4], std::byte* room, Store store) {
  struct alignas(8) Pair {
    T first, second;
  };
  constexpr int kPairs = kTilesN * 4;
  const int lane = thread_index() % kLanes;
#pragma unroll
  for (int m = 0; m < kTilesM; ++m) {
#pragma unroll
    for (int n = 0; n < kTilesN; ++n)
#pragma unroll
      for (int high = 0; high < 2; ++high)
        dev::write(room + sum_place<kTilesN>(high * 8 + lane / 4, n * 8 + lane % 4 * 2),
                   Pair{sum[m][n][2 * high], sum[m][n][2 * high + 1]});
    __syncwarp();
#pragma unroll 1
    for (int i = lane; i < 16 * kPairs; i += kLanes) {
      const int row = i / kPairs, column = i % kPairs * 2;
      const auto pair = dev::read<Pair>(room + sum_place<kTilesN>(row, column));
      store(m * 16 + row, column, pair.first, pair.second);
    }
    __syncwarp();
  }
}

}  // namespace vla::cuda
