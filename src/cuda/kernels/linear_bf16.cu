// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/linear_bf16.h"

#include "cuda/kernels/halved_norm.h"
#include "cuda/kernels/share.h"
#include "cuda/kernels/store_sums.h"

namespace vla::cuda {
namespace {

/// Four warps in a 2 x 2 grid. Each computes kTilesM x kTilesN products of 16 x 8. Shared memory holds kStages steps of
/// the depth.
template <int kTilesM_, int kTilesN_>
struct Shape {
  static constexpr int kTilesM = kTilesM_, kTilesN = kTilesN_, kStages = 4;
  static constexpr int kRows = 2 * kTilesM * 16, kColumns = 2 * kTilesN * 8;
  static constexpr int kRowBytes = kBf16Depth * 2, kStage = (kRows + kColumns) * kRowBytes;
};

/// Offset of 16 bytes of a row in a stage. The eight rows of a matrix load are in different banks.
VLA_DEVICE int place(int row, int chunk) { return row * kBf16Depth * 2 + (chunk ^ (row >> 1 & 3)) * 16; }

/// Copies a step of the depth of some rows to a stage, padded with zeros after the last row and the depth.
template <int kRows>
VLA_DEVICE void fetch(std::byte* to, const std::uint16_t* from, std::int64_t stride, int row0, int n_row, int step,
                      int depth) {
  const int chunk = thread_index() % 4, k = step * kBf16Depth + chunk * 8;
  const int left = (depth - k) * 2, size = left < 0 ? 0 : left > 16 ? 16 : left;
#pragma unroll
  for (int i = 0; i < kRows; i += 32) {
    const int row = i + thread_index() / 4;
    const bool valid = row0 + row < n_row && size > 0;
    dev::copy_async(to + place(row, chunk), valid ? from + (row0 + row) * stride + k : from, valid ? size : 0);
  }
}
template <class S>
VLA_DEVICE void fetch(const LinearBf16Job& job, int row0, int column0, int step, std::byte* stage) {
  fetch<S::kRows>(stage, static_cast<const std::uint16_t*>(job.x), job.x_stride, row0, job.n_row, step, job.depth);
  fetch<S::kColumns>(stage + S::kRows * S::kRowBytes, job.weight, job.weight_stride, column0, job.n_column, step,
                     job.depth);
}

/// Multiplies a stage in two steps of 16 of the depth.
template <class S>
VLA_DEVICE void multiply_stage(const std::byte* stage, int warp_row, int warp_column,
                               float (&sum)[S::kTilesM][S::kTilesN][4]) {
  const int lane = thread_index() % kLanes;
  const std::byte* w = stage + S::kRows * S::kRowBytes;
#pragma unroll
  for (int half = 0; half < 2; ++half) {
    unsigned a[S::kTilesM][4];
#pragma unroll
    for (int m = 0; m < S::kTilesM; ++m)
      dev::load_matrices(a[m], stage + place(warp_row + m * 16 + lane % 16, half * 2 + lane / 16));
#pragma unroll
    for (int n = 0; n < S::kTilesN; n += 2) {
      unsigned b[4];  // two registers for each half of 16 columns
      dev::load_matrices(b, w + place(warp_column + n * 8 + lane / 16 * 8 + lane % 8, half * 2 + lane / 8 % 2));
#pragma unroll
      for (int m = 0; m < S::kTilesM; ++m) {
        dev::multiply_bf16(sum[m][n], a[m], b[0], b[1]);
        dev::multiply_bf16(sum[m][n + 1], a[m], b[2], b[3]);
      }
    }
  }
}

template <class S>
VLA_DEVICE void multiply(const LinearBf16Job& job) {
  dev::wait_for_earlier();
  std::byte* shared = dev::shared_memory();
  const int warp = thread_index() / kLanes;
  const int warp_row = warp % 2 * S::kTilesM * 16, warp_column = warp / 2 * S::kTilesN * 8;
  const int row0 = static_cast<int>(blockIdx.y) * S::kRows, column0 = static_cast<int>(blockIdx.x) * S::kColumns;
  const Share share(job);

  float sum[S::kTilesM][S::kTilesN][4] = {};
#pragma unroll
  for (int i = 0; i < S::kStages - 1; ++i) {
    if (share.first + i < share.end) fetch<S>(job, row0, column0, share.first + i, shared + i * S::kStage);
    dev::commit_copies();  // commits a group even if it is empty, because waiting counts groups
  }
  for (int step = share.first; step < share.end; ++step) {
    const int i = step - share.first;
    dev::wait_copies<S::kStages - 2>();
    __syncthreads();  // the stage is visible to all threads, and all have read the stage that is overwritten next
    const int ahead = i + S::kStages - 1;
    if (share.first + ahead < share.end)
      fetch<S>(job, row0, column0, share.first + ahead, shared + ahead % S::kStages * S::kStage);
    dev::commit_copies();
    multiply_stage<S>(shared + i % S::kStages * S::kStage, warp_row, warp_column, sum);
  }

  dev::let_next_begin();
  dev::wait_copies<0>();
  __syncthreads();  // the stages' memory is reused for sums
  store_sums(sum, shared + warp * kSumBytes<S::kTilesN>, [&](int row, int column, float first, float second) {
    row += row0 + warp_row, column += column0 + warp_column;
    if (row < job.n_row && column < job.n_column) store_pair(job, first, second, row, column);
  });
}

/// Loads elements k to k + 7 of a row, zeros from `end` on. `is_aligned`: every row is aligned to 16 bytes.
VLA_DEVICE void eight(const float* row, int k, int end, bool is_aligned, float (&to)[8]) {
  if (is_aligned && k + 8 <= end) {
#pragma unroll
    for (int i = 0; i < 8; i += 4) {
      const float4 four = *reinterpret_cast<const float4*>(row + k + i);
      to[i] = four.x, to[i + 1] = four.y, to[i + 2] = four.z, to[i + 3] = four.w;
    }
  } else {
#pragma unroll
    for (int i = 0; i < 8; ++i) to[i] = k + i < end ? row[k + i] : 0;
  }
}

/// A warp computes two columns of up to kBf16FewRows rows; its lanes split the depth.
VLA_DEVICE void multiply_few(const LinearBf16Job& job) {
  const int lane = thread_index() % kLanes, column = (static_cast<int>(blockIdx.x) * 4 + thread_index() / kLanes) * 2;
  const int row0 = static_cast<int>(blockIdx.y) * kBf16FewRows;
  if (column >= job.n_column) return;  // the whole warp
  const bool has_second = column + 1 < job.n_column;
  const Share share(job);
  const int end = share.end * kBf16Depth < job.depth ? share.end * kBf16Depth : job.depth;
  const auto* rows = static_cast<const float*>(job.x) + row0 * job.x_stride;
  const bool is_aligned = reinterpret_cast<std::uint64_t>(job.x) % 16 == 0 && job.x_stride % 4 == 0;
  float sum[kBf16FewRows][2] = {};
  for (int k = share.first * kBf16Depth + lane * 8; k < end; k += kLanes * 8) {
    const auto weights = [&](int of, float(&to)[8]) {
      const uint4 words = *reinterpret_cast<const uint4*>(job.weight + of * job.weight_stride + k);  // padded to 8
      const unsigned pairs[4] = {words.x, words.y, words.z, words.w};
#pragma unroll
      for (int i = 0; i < 8; ++i) {
        const unsigned bits = i % 2 ? pairs[i / 2] & 0xffff0000U : pairs[i / 2] << 16;
        to[i] = k + i < end ? dev::float_of(static_cast<int>(bits)) : 0;
      }
    };
    float w[2][8];
    weights(column, w[0]);
    weights(has_second ? column + 1 : column, w[1]);
#pragma unroll
    for (int r = 0; r < kBf16FewRows; ++r) {
      if (row0 + r >= job.n_row) break;
      float x[8];
      eight(rows + r * job.x_stride, k, end, is_aligned, x);
#pragma unroll
      for (int i = 0; i < 8; ++i) sum[r][0] += x[i] * w[0][i], sum[r][1] += x[i] * w[1][i];
    }
  }
  float first = 0, second = 0;  // the row that this lane stores
#pragma unroll
  for (int r = 0; r < kBf16FewRows; ++r) {
    const float one = sum_of_warp(sum[r][0]), two = sum_of_warp(sum[r][1]);
    if (lane == r) first = one, second = two;
  }
  if (lane < kBf16FewRows && row0 + lane < job.n_row) store_pair(job, first, second, row0 + lane, column);
}

}  // namespace

using Shape128 = Shape<4, 8>;
using Shape64 = Shape<2, 4>;

VLA_EARLY_KERNEL(linear_bf16_128, 128, 2, LinearBf16Job) { multiply<Shape128>(job); }
VLA_EARLY_KERNEL(linear_bf16_64, 128, 4, LinearBf16Job) { multiply<Shape64>(job); }
VLA_KERNEL(linear_bf16_few, 128, 4, LinearBf16Job) { multiply_few(job); }

namespace {

/// Adds four adjacent sums over all shares of the depth, in order, from column `at` of a row of sums on; the first n
/// exist. kTogether: all four exist and are aligned, and there are at most kMostSplits shares, loaded at once.
template <bool kTogether>
VLA_DEVICE Four add_row(const LinearBf16Job& job, int row, int at, int n) {
  const std::int64_t apart = static_cast<std::int64_t>(job.n_row_x()) * job.n_sum();
  const float* from = job.partial + static_cast<std::int64_t>(row) * job.n_sum() + at;
  Four sum = {};
  if constexpr (kTogether) {
    Four share[kMostSplits];
#pragma unroll
    for (int z = 0; z < kMostSplits; ++z) share[z] = z < job.n_split ? load_four(from + z * apart, true, 4) : Four{};
#pragma unroll
    for (int z = 0; z < kMostSplits; ++z)
#pragma unroll
      for (int c = 0; c < 4; ++c) sum.of[c] += share[z].of[c];
  } else {
#pragma unroll 1
    for (int z = 0; z < job.n_split; ++z) {
      const Four share = load_four(from + z * apart, false, n);
#pragma unroll
      for (int c = 0; c < 4; ++c) sum.of[c] += share.of[c];
    }
  }
  return sum;
}
/// The same, and ends the norm of x, if there is one.
template <bool kTogether>
VLA_DEVICE Four add_shares(const LinearBf16Job& job, int row, const RowTerms& terms, int at, int n) {
  NormedColumns<4> all;
  all.load(job, [&](int of, float(&to)[4]) {
    const Four sum = add_row<kTogether>(job, of, at, n);
#pragma unroll
    for (int c = 0; c < 4; ++c) to[c] = sum.of[c];
  });
  Four sum = add_row<kTogether>(job, row, at, n);
#pragma unroll
  for (int c = 0; c < 4; ++c) sum.of[c] = all.normed(terms, sum.of[c], c);
  return sum;
}

template <bool kTogether>
VLA_DEVICE void finish_four(const LinearBf16Job& job, int row, const RowTerms& terms, int column) {
  const int n = job.n_column - column;
  const auto load = [&](const float* from, std::int64_t at) {
    return from ? load_four(from + at, kTogether, n) : Four{};
  };
  const Four sum = add_shares<kTogether>(job, row, terms, job.n_sum() - job.n_column + column, n);
  Four gate = load(job.end.gate, static_cast<std::int64_t>(row) * job.n_column + column);
  if (job.gate_weight) {
    const Four bias = load(job.gate_bias, column);
    gate = add_shares<kTogether>(job, row, terms, column, n);
#pragma unroll
    for (int c = 0; c < 4; ++c) gate.of[c] = dev::add(gate.of[c], bias.of[c]);
  }
  finish_four<kTogether>(job.end, row, column, job.n_column, sum, job.gate_weight || job.end.gate, gate);
}

/// Adds the shares of four adjacent pairs of a head, and stores both elements of each rotated.
template <bool kTogether>
VLA_DEVICE void finish_four_pairs(const LinearBf16Job& job, int row, const RowTerms& terms, int pair) {
  const int column = job.rotation.first_column(pair), half = job.rotation.d_head / 2;
  const float* const cosines = cosines_of(job.rotation, row, column);
  const Four cosine = load_four(cosines, kTogether, 4), sine = load_four(cosines + half, kTogether, 4);
  const auto add = [&](int from) {
    Four sum = add_shares<kTogether>(job, row, terms, from, 4);
    if (job.end.bias == nullptr) return sum;
    const Four bias = load_four(job.end.bias + from, kTogether, 4);
#pragma unroll
    for (int c = 0; c < 4; ++c) sum.of[c] = dev::add(sum.of[c], bias.of[c]);
    return sum;
  };
  Four low = add(column), high = add(column + half);
  rotate(low.of, high.of, cosine.of, sine.of);
  store_y(job.end, row, column, low, kTogether, 4);
  store_y(job.end, row, column + half, high, kTogether, 4);
}

/// Adds the partial sums of a split and computes y.
VLA_DEVICE void finish_partial(const LinearBf16Job& job, int block) {
  const int row = static_cast<int>(blockIdx.y), four = (block * 128 + thread_index()) * 4;
  const bool rotates = job.rotation.table != nullptr;
  if (four >= (rotates ? job.n_column / 2 : job.n_column)) return;
  const auto bits = [](const void* p) { return reinterpret_cast<std::uint64_t>(p); };
  const auto others = bits(job.gate_bias) | bits(job.partial) | bits(job.rotation.table);
  const bool together = is_of_fours(job.end, job.n_column) && others % 16 == 0 && job.n_split <= kMostSplits;
  const RowTerms terms = terms_of_row(job, row);
  if (rotates)
    together ? finish_four_pairs<true>(job, row, terms, four) : finish_four_pairs<false>(job, row, terms, four);
  else
    together ? finish_four<true>(job, row, terms, four) : finish_four<false>(job, row, terms, four);
}

}  // namespace

VLA_KERNEL(linear_bf16_finish, 128, 4, LinearBf16Job) { finish_partial(job, static_cast<int>(blockIdx.x)); }
VLA_KERNEL(linear_bf16_finishes, 128, 4, Several<LinearBf16Job>) {
  run_one(job, blockIdx.x, [](const LinearBf16Job& one, int block) { finish_partial(one, block); });
}

}  // namespace vla::cuda
