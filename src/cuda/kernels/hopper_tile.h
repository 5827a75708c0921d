// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/kernels/finish.h"
#include "cuda/kernels/hopper.h"

/// Shared by the tiled products for Hopper. A block computes kColumns x kRows sums, y transposed: rows are fewer than
/// columns, and the second size of a warpgroup's product may be any multiple of 16. Each warpgroup has 64 columns of y
/// and all rows.
namespace vla::cuda {

/// Copies a step, 128 bytes of the depth, of kRows rows to swizzled rows, with eight threads per row. Pads with zeros
/// after the last row and after the depth. Strides and depth are in bytes.
template <int kRows, int kThreads>
class FetchRows {
 public:
  VLA_DEVICE FetchRows(const void* from, std::int64_t stride, int row0, int n_row, int depth)
      : stride_(stride * kRowsAtOnce), n_left_(n_row - row0 - thread_index() / 8), depth_(depth) {
    const int chunk = thread_index() % 8, row = thread_index() / 8;
    from_ = static_cast<const std::byte*>(from) + (row0 + row) * stride + chunk * 16;
    to_ = swizzled(row, chunk);
  }
  VLA_DEVICE void operator()(std::byte* stage, int step) const {
    const int left = depth_ - step * kSwizzledRow - thread_index() % 8 * 16;
    const int size = left < 0 ? 0 : left > 16 ? 16 : left;
    const std::byte* from = from_ + static_cast<std::int64_t>(step) * kSwizzledRow;
#pragma unroll
    for (int i = 0; i < kRows; i += kRowsAtOnce) {
      if (kRows % kRowsAtOnce != 0 && i + thread_index() / 8 >= kRows) break;
      dev::copy_async(stage + to_ + i * kSwizzledRow, from, i < n_left_ ? size : 0);
      from += stride_;
    }
  }

 private:
  static constexpr int kRowsAtOnce = kThreads / 8;
  static_assert(kRowsAtOnce % kSwizzledRows == 0);
  const std::byte* from_;  // this thread's chunk of its first row; a copy of size 0 reads nothing
  std::int64_t stride_;
  int n_left_, depth_, to_;
};

/// What a tile does with y besides storing it: nothing. If kTakesRows, it gets y of all rows and columns of the tile,
/// in the same order in each lane of a warp, and there is no activation.
struct LeavesY {
  static constexpr bool kTakesRows = false;
  VLA_DEVICE void operator()(int, int, const float (&)[4]) const {}
};

/// The end of a tile. Its sums pass through shared memory, in rows of kColumns words and four more against bank
/// conflicts. A thread finishes the same four columns of every kRowsAtOnce-th row. Gated: the first half of a row holds
/// the sums of the gate's matrix, the second half the other matrix's sums of the same columns.
/// If the depth is split, a block leaves partial sums, or the blocks of a tile are a cluster: each finishes rows of its
/// own, for which it adds all blocks' sums in the order of the shares.
template <class Sum, int kColumns, int kRows, bool kGated>
class TileEnd {
 public:
  template <class Job>
  VLA_DEVICE TileEnd(const Job& job, const float* gate_bias, int n_row, int row0, int column0)
      : e_(job.end),
        gate_bias_(gate_bias),
        row0_(row0),
        end_row_(n_row),
        n_split_(job.n_split),
        n_column_(job.n_column),
        column_(column0 + thread_index() % kQuads * 4) {
    n_ = job.n_column - column_;
    const int left = n_row - row0;
    end_ = n_ <= 0 ? 0 : left < kRows ? left : kRows;
    const auto bits = [](const void* p) { return reinterpret_cast<std::uint64_t>(p); };
    const auto all = bits(e_.bias) | bits(e_.factor) | bits(e_.gate) | bits(e_.residual) | bits(e_.y) | bits(gate_bias);
    together_ = job.n_column % 4 == 0 && e_.y_stride % 4 == 0 && (all | bits(job.partial)) % 16 == 0;
  }

  /// Writes a thread's sums of wgmma; lanes of a warp write to different banks.
  static VLA_DEVICE void place(const Sum (&sum)[kRows / 2], std::byte* to) {
    const int lane = thread_index() % kLanes, column = thread_index() / kLanes * 16 + lane / 4;
#pragma unroll
    for (int i = 0; i < kRows / 2; ++i) {
      const int row = i / 4 * 8 + lane % 4 * 2 + i % 2;
      dev::write(to + (row * (kColumns + 4) + column + i / 2 % 2 * 8) * 4, sum[i]);
    }
  }

  /// Stores word(of_row(row), a sum) to the partial sums of one share of the depth, which begin at `partial`, once all
  /// threads of the block have called it. In each row the gate's sums come first.
  template <class OfRow, class Word>
  VLA_DEVICE void leave(const std::byte* sums, void* partial, OfRow of_row, Word word) const {
    __syncthreads();  // sums of all warps are there, to be left
    if (together_)
      leave_rows<4, true>(sums, partial, of_row, word);
    else
      leave_rows<1, false>(sums, partial, of_row, word);
  }
  /// What a warp of the block that has no sums calls in the place of `leave` or of `finish` of an undivided depth.
  static VLA_DEVICE void attend() { __syncthreads(); }
  /// Computes y from value(of_row(row), a sum, index of the column among the thread's four, whether it is the gate's),
  /// once all threads of the block, or of the cluster, have called it. If value has `load`, that is called before, with
  /// a function that returns four sums of a row, of the gate or not. `then` also gets y, see LeavesY.
  template <class OfRow, class Value, class Then = LeavesY>
  VLA_DEVICE void finish(const std::byte* sums, OfRow of_row, Value value, Then then = {}) const {
    if (n_split_ == 1) {
      __syncthreads();  // sums of all warps are there
      return finish_part<false>(sums, of_row, value, then);
    }
    dev::meet_cluster();  // sums of all blocks are there
    finish_part<true>(sums, of_row, value, then);
    dev::leave_cluster();  // no block reads them any more
  }

 private:
  static constexpr int kQuads = kColumns / 4 / (kGated ? 2 : 1), kRowsAtOnce = kColumns * 2 / kQuads;
  struct Sums {
    Sum of[4];
  };

  template <int kRowsAhead, bool kTogether, class OfRow, class Word>
  VLA_DEVICE void leave_rows(const std::byte* sums, void* partial, OfRow of_row, Word word) const {
    constexpr int kHalves = kGated ? 2 : 1;
    auto* to = static_cast<unsigned*>(partial) + column_;
#pragma unroll 1
    for (int first = thread_index() / kQuads; first < end_; first += kRowsAtOnce * kRowsAhead)
#pragma unroll
      for (int i = 0; i < kRowsAhead; ++i) {
        const int row = first + kRowsAtOnce * i;
        if (row >= end_) break;
        const auto of = of_row(row0_ + row);
#pragma unroll
        for (int half = 0; half < kHalves; ++half) {
          const Sums four = sums_of<false>(sums, row, half);
          const unsigned words[4] = {word(of, four.of[0]), word(of, four.of[1]), word(of, four.of[2]),
                                     word(of, four.of[3])};
          const std::int64_t at = static_cast<std::int64_t>(row0_ + row) * kHalves + half;
          store_four(to + at * n_column_, words, kTogether, n_);
        }
      }
  }
  /// kSplit: whether a cluster adds shares. Then the rare activations share code, since the shares' loads make it long.
  template <bool kSplit, class OfRow, class Value, class Then>
  VLA_DEVICE void finish_part(const std::byte* sums, OfRow of_row, Value value, Then then) const {
    constexpr int kRowsAhead = kSplit ? 2 : 4;
    const auto ahead = [&](auto activate) {
      finish_rows<kRowsAhead, true, kSplit>(sums, of_row, value, activate, then);
    };
    const auto one = [&](auto activate) { finish_rows<1, false, kSplit>(sums, of_row, value, activate, then); };
    if constexpr (Then::kTakesRows) {
      const auto same = [](float x) { return x; };
      return together_ ? ahead(same) : one(same);
    }
    const bool is_rare = e_.activation != Activation::none && !is_sigmoid(e_.activation);
    if (!together_ || (kSplit && is_rare)) return one([&](float x) { return activate(e_.activation, x); });
    with_activation(e_.activation, ahead, [&](auto activate) {
      if constexpr (!kSplit) one(activate);
    });
  }
  /// Implements `finish` for one activation. Loads of kRowsAhead rows are in flight at a time, also of other blocks'
  /// sums.
  template <int kRowsAhead, bool kTogether, bool kSplit, class OfRow, class Value, class Activate, class Then>
  VLA_DEVICE void finish_rows(const std::byte* sums, OfRow of_row, Value value, Activate activate, Then then) const {
    const auto load = [&](const float* from, std::int64_t at, float otherwise) {
      return from && n_ > 0 ? load_four(from + at, kTogether || together_, n_)
                            : Four{{otherwise, otherwise, otherwise, otherwise}};
    };
    const auto sums_of_row = [&](int row, bool of_gate) {
      return sums_of<kSplit>(sums, row - row0_, kGated && !of_gate ? 1 : 0);
    };
    if constexpr (requires { value.load(sums_of_row); }) value.load(sums_of_row);
    const Four bias = load(e_.bias, column_, kAddsNothing), factor = load(e_.factor, column_, kScalesNothing);
    const Four gate_bias = load(kGated ? gate_bias_ : nullptr, column_, kAddsNothing);
    const int end = Then::kTakesRows ? kRows : end_;
    const int part = kSplit ? static_cast<int>(blockIdx.z) : 0, apart = kRowsAtOnce * (kSplit ? n_split_ : 1);
#pragma unroll 1
    for (int first = thread_index() / kQuads + kRowsAtOnce * part; first < end; first += apart * kRowsAhead) {
      Four gate[kRowsAhead], residual[kRowsAhead];
      decltype(of_row(0)) of[kRowsAhead] = {};
      Sums sum[kRowsAhead] = {}, gate_sum[kRowsAhead] = {};
      const auto read = [&](int i, int row) {
        sum[i] = sums_of<kSplit>(sums, row, kGated ? 1 : 0);
        if constexpr (kGated) gate_sum[i] = sums_of<kSplit>(sums, row, 0);
      };
#pragma unroll
      for (int i = 0; i < kRowsAhead; ++i) {
        const int row = row0_ + first + apart * i;
        if (first + apart * i >= end) break;
        of[i] = of_row(row);
        const std::int64_t at =
            static_cast<std::int64_t>(Then::kTakesRows && row >= end_row_ ? row0_ : row) * n_column_ + column_;
        gate[i] = load(kGated ? nullptr : e_.gate, at, 0);
        residual[i] = load(e_.residual, at, kAddsNothing);
        if constexpr (kSplit) read(i, row - row0_);
      }
#pragma unroll
      for (int i = 0; i < kRowsAhead; ++i) {
        const int row = first + apart * i;
        if (row >= end) break;
        if constexpr (!kSplit) read(i, row);
        if constexpr (kGated) {
#pragma unroll
          for (int c = 0; c < 4; ++c)
            gate[i].of[c] = dev::add(value(of[i], gate_sum[i].of[c], c, true), gate_bias.of[c]);
        }
        Four y;
#pragma unroll
        for (int c = 0; c < 4; ++c)
          y.of[c] = cuda::finish(e_, kGated || e_.gate != nullptr, value(of[i], sum[i].of[c], c, false), bias.of[c],
                                 factor.of[c], gate[i].of[c], residual[i].of[c], activate);
        if (!Then::kTakesRows || (row0_ + row < end_row_ && n_ > 0))
          store_y(e_, row0_ + row, column_, y, kTogether || together_, n_);
        then(row0_ + row, column_, y.of);
      }
    }
  }
  static VLA_DEVICE float of_bits(unsigned bits, float) { return dev::float_of(static_cast<int>(bits)); }
  static VLA_DEVICE int of_bits(unsigned bits, int) { return static_cast<int>(bits); }
  static VLA_DEVICE Sums sums_in(const uint4& four) {
    return {{of_bits(four.x, Sum()), of_bits(four.y, Sum()), of_bits(four.z, Sum()), of_bits(four.w, Sum())}};
  }
  /// A thread's four sums of a row.
  template <bool kSplit>
  VLA_DEVICE Sums sums_of(const std::byte* sums, int row, int half) const {
    sums += (row * (kColumns + 4) + (half * kQuads + thread_index() % kQuads) * 4) * 4;
    if constexpr (kSplit)
      return add_shares(sums);
    else
      return sums_in(dev::read<uint4>(sums));
  }
  /// Adds what the cluster's blocks have at `sums`; a share that there is not is zeros.
  VLA_DEVICE Sums add_shares(const std::byte* sums) const {
    uint4 share[kMostSplits];
#pragma unroll
    for (int z = 0; z < kMostSplits; ++z) share[z] = z < n_split_ ? dev::read_of_block(sums, z) : uint4{0, 0, 0, 0};
    Sums all = {};
#pragma unroll
    for (int z = 0; z < kMostSplits; ++z) {
      const Sums one = sums_in(share[z]);
#pragma unroll
      for (int c = 0; c < 4; ++c) all.of[c] += one.of[c];
    }
    return all;
  }

  const Epilogue& e_;
  const float* gate_bias_;
  int row0_, end_row_, n_split_, n_column_, column_, n_, end_;  // n_: columns from column_ on; end_: rows to finish
  bool together_;
};

}  // namespace vla::cuda
