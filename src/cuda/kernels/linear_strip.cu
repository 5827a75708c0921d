// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/halved_norm.h"
#include "cuda/kernels/share.h"

namespace vla::cuda {
namespace {

constexpr int kWarps = 8, kThreads = kWarps * kLanes, kStripRows = 64, kTilesM = kStripRows / 16;

/// The two halves of a block's columns. gated: the gate's columns, then those of the other matrix. rotated: the first
/// elements of the pairs that are rotated, then the second ones. none: there are no halves.
enum class Halves { none, gated, rotated };

/// A block computes sums of up to 64 rows and kColumns columns. A warp has kTilesN * 8 of the columns; warps with the
/// same columns take the steps of the depth in turn.
template <int kTilesN_, int kWarpsN_, Halves kHalves, bool kBegins_ = false>
struct Strip {
  static constexpr int kTilesN = kTilesN_, kWarpsN = kWarpsN_, kWarpsK = kWarps / kWarpsN;
  static constexpr bool kBegins = kBegins_;  // whether it begins a norm
  static_assert(!kBegins || kHalves == Halves::none);
  static constexpr bool kGated = kHalves == Halves::gated, kRotated = kHalves == Halves::rotated;
  static constexpr int kColumns = kTilesN * 8 * kWarpsN;
  static constexpr int kColumnsY = kHalves == Halves::none ? kColumns : kColumns / 2;  // of y, or pairs
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
      x_place_[r] = static_cast<unsigned>((nearest(row0 + r * 8 + lane / 4, job.n_row_x()) - row0) * job.x_stride * 2);
#pragma unroll
    for (int n = 0; n < S::kTilesN; ++n) {
      const int column = of_warp + n * 8;
      const bool is_second = column >= S::kColumnsY, is_gate = S::kGated && !is_second;
      const int of = column0 + (is_second ? column - S::kColumnsY : column) + lane / 4;
      weight_[n] =
          reinterpret_cast<const std::byte*>(is_gate ? job.gate_weight : job.weight) +
          row_of(job, nearest(of, S::kRotated ? job.n_column / 2 : job.n_column), is_second) * job.weight_stride * 2;
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
  /// The matrix's row for a column, or for the first or second element of a pair.
  static VLA_DEVICE int row_of(const LinearBf16Job& job, int of, bool is_second) {
    return S::kRotated ? job.rotation.first_column(of) + (is_second ? job.rotation.d_head / 2 : 0) : of;
  }
  static VLA_DEVICE int chunk_of(int step) { return step * (kBf16Depth / 8) + thread_index() % 4; }

  const std::byte *x_, *weight_[S::kTilesN];
  unsigned x_place_[2 * kTilesM];
  int n_chunk_;
};

/// The part of a strip that a thread stores: two adjacent columns of some rows.
template <class S>
struct Stores {
  static constexpr int kPairs = S::kColumnsY / 2, kEach = kStripRows * kPairs / kThreads;
  int column = thread_index() % kPairs * 2;

  VLA_DEVICE int row(int i) const {
    const int number = thread_index() / kPairs;
    // If a transaction reads two or four rows, this order puts them in different banks.
    const int first = kPairs == 8 ? (number & ~3) + number % 2 * 2 + number / 2 % 2 : number;
    return first + i * (kThreads / kPairs);
  }
};

/// Where shared memory has a row's RowTerms.
template <class S>
VLA_DEVICE std::byte* place_of_terms(int row) {
  return dev::shared_memory() + S::kWarpsK * kStripRows * S::kRowBytes + row * sizeof(RowTerms);
}
/// Adds the sums of the warps that share two columns, from `column` on, in the warps' order.
template <class S>
VLA_DEVICE float2 add_warps(int row, int column) {
  float2 sum = {0, 0};
#pragma unroll
  for (int w = 0; w < S::kWarpsK; ++w) {
    const auto pair = dev::read<float2>(dev::shared_memory() + (w * kStripRows + row) * S::kRowBytes + column * 4);
    sum.x += pair.x, sum.y += pair.y;
  }
  return sum;
}

/// Ends the norm of x, if there is one, in two columns of the strip from `column` on.
template <class S>
struct NormedPair {
  int column;
  NormedColumns<2> all = {};

  /// Sums of all warps must be there.
  VLA_DEVICE NormedPair(const LinearBf16Job& job, int first) : column(first) {
    if (job.n_split == 1)
      all.load(job, [&](int row, float(&to)[2]) {
        const float2 sum = add_warps<S>(row, column);
        to[0] = sum.x, to[1] = sum.y;
      });
  }
  VLA_DEVICE float2 operator()(int row) const {
    const float2 sum = add_warps<S>(row, column);
    const auto terms = dev::read<RowTerms>(place_of_terms<S>(row));
    return {all.normed(terms, sum.x, 0), all.normed(terms, sum.y, 1)};
  }
};

/// Adds the sums of warps that share columns, stores pairs of y, and begins a norm of it if the strip does that.
template <class S>
VLA_DEVICE void add_and_store(const LinearBf16Job& job, int row0, int column0) {
  const Stores<S> mine;
  const int column = column0 + mine.column;
  const int n_row = job.n_split == 1 ? job.n_row : job.n_row_x();
  const auto valid = [&](int row) { return row0 + row < n_row && column < job.n_column; };
  PairEnds ends[mine.kEach];
#pragma unroll
  for (int i = 0; i < mine.kEach; ++i)
    if (job.n_split == 1 && valid(mine.row(i))) ends[i] = load_ends(job.end, row0 + mine.row(i), column, job.n_column);
  __syncthreads();  // sums of all warps are there
  const NormedPair<S> of_gate(job, mine.column), of_y(job, S::kColumns - S::kColumnsY + mine.column);
#pragma unroll
  for (int i = 0; i < mine.kEach; ++i) {
    const int row = mine.row(i);
    const float2 gate = S::kGated ? of_gate(row) : float2{0, 0}, sum = of_y(row);
    if constexpr (S::kBegins) {
      float2 y = {0, 0};
      if (valid(row)) y = finish_pair(job.end, ends[i], sum.x, sum.y, row0 + row, column);
      begin_norm<S::kColumns / 2, 2>(job, row0 + row, column, {y.x, y.y});
      continue;
    }
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

/// The same for two adjacent pairs, which are rotated if there is a table.
template <class S>
VLA_DEVICE void add_and_rotate(const LinearBf16Job& job, int row0, int pair0) {
  const Stores<S> mine;
  const int pair = pair0 + mine.column, half = job.rotation.d_head / 2, column = job.rotation.first_column(pair);
  const float* const bias = job.end.bias;
  const bool rotates = job.rotation.table != nullptr, is_valid = pair < job.n_column / 2;
  float2 low_bias = {kAddsNothing, kAddsNothing}, high_bias = low_bias;
  if (is_valid && bias != nullptr)
    low_bias = {bias[column], bias[column + 1]}, high_bias = {bias[column + half], bias[column + half + 1]};
  float turn[mine.kEach][4] = {};  // two cosines, two sines
#pragma unroll
  for (int i = 0; i < mine.kEach; ++i) {
    if (!rotates || !is_valid || row0 + mine.row(i) >= job.n_row) continue;
    const float* const cosine = cosines_of(job.rotation, row0 + mine.row(i), column);
    turn[i][0] = cosine[0], turn[i][1] = cosine[1], turn[i][2] = cosine[half], turn[i][3] = cosine[half + 1];
  }
  __syncthreads();  // sums of all warps are there
  const NormedPair<S> of_first(job, mine.column), of_second(job, S::kColumnsY + mine.column);
#pragma unroll
  for (int i = 0; i < mine.kEach; ++i) {
    const int row = mine.row(i);
    const float2 first = of_first(row), second = of_second(row);
    if (!is_valid || row0 + row >= job.n_row) continue;
    float low[2] = {dev::add(first.x, low_bias.x), dev::add(first.y, low_bias.y)};
    float high[2] = {dev::add(second.x, high_bias.x), dev::add(second.y, high_bias.y)};
    if (rotates) rotate(low, high, turn[i], turn[i] + 2);
    store_y(job.end, row0 + row, column, low[0], low[1], true);
    store_y(job.end, row0 + row, column + half, high[0], high[1], true);
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
  if (thread_index() < kStripRows)
    dev::write(place_of_terms<S>(thread_index()),
               job.n_split > 1 ? RowTerms() : terms_of_row(job, row0 + thread_index()));
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
  if constexpr (S::kRotated)
    add_and_rotate<S>(job, row0, column0);
  else
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
VLA_STRIP(16, 2, 1, Halves::none)
VLA_STRIP(32, 4, 1, Halves::none)
VLA_STRIP(64, 4, 2, Halves::none)
VLA_STRIP(128, 4, 4, Halves::none)
VLA_STRIP(16_begins, 2, 1, Halves::none, true)
VLA_STRIP(32_begins, 4, 1, Halves::none, true)
VLA_STRIP(64_begins, 4, 2, Halves::none, true)
VLA_STRIP(16_gated, 2, 1, Halves::gated)
VLA_STRIP(16_rotated, 2, 1, Halves::rotated)
VLA_STRIP(32_gated, 4, 1, Halves::gated)
VLA_STRIP(32_rotated, 4, 1, Halves::rotated)
VLA_STRIP(64_gated, 4, 2, Halves::gated)
VLA_STRIP(64_rotated, 4, 2, Halves::rotated)
VLA_STRIP(128_gated, 4, 4, Halves::gated)
VLA_STRIPS(16, 2, 1, Halves::none)
VLA_STRIPS(16_rotated, 2, 1, Halves::rotated)
VLA_STRIPS(32, 4, 1, Halves::none)
VLA_STRIPS(32_rotated, 4, 1, Halves::rotated)
VLA_STRIPS(64, 4, 2, Halves::none)
VLA_STRIPS(64_rotated, 4, 2, Halves::rotated)
#undef VLA_STRIP
#undef VLA_STRIPS

}  // namespace vla::cuda
