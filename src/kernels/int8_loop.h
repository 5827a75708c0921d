// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/int8_panels.h"
#include "kernels/linear_stripe.h"
#include "kernels/tile_heights.h"

/// The loop around a tile of integer products of x's int8 codes and ternary, int4 or int8 weights: how work is split
/// into items, and which operands stay in which cache.
///
/// A panel is multiplied a step of the depth at a time. The step stays in a cache while all rows of a block of x are
/// multiplied by it. Weights of two or four bits are expanded to bytes once per step; for few rows the tile unpacks
/// them itself. Sums are integers, so their order does not matter.
namespace vla::kernels {

/// Turns a row's sums into values: subtracts the weights' offset, then computes float(sum) * (scale / s), with the
/// scale of W or of the column and the row's s. Integers wrap, because a prediction (lower/cpu/predict.cpp) multiplies
/// rows that were never quantized.
template <class V, class Weights, int kColumns, int kOffset>
VLA_INLINE void scale_sums(const LinearJob::Part& part, const Stripe& s, const RowScale& row, const std::int32_t* from,
                           float* to) {
  const auto offset = static_cast<std::int32_t>(kOffset * static_cast<std::uint32_t>(row.sum));
  for (std::int64_t n = 0; n < kColumns; n += V::width) {
    typename V::Int sums;
    std::memcpy(&sums, from + n, sizeof(sums));
    typename V::Float step;
    if constexpr (Weights::kManyScales)
      step = load<V>(part.scale + s.column + n, s.n_column > n ? s.n_column - n : 0) / row.s;
    else
      step = V::set(*part.scale / row.s);
    V::store(to + n, __builtin_convertvector(sums - offset, typename V::Float) * step);
  }
}

template <class Tile>
constexpr bool kTakesPairs = requires {
  Tile::kPairs;
};
template <class Tile>
constexpr bool kHasPanel = requires {
  typename Tile::Panel;
};
template <class Tile, class Weights>
using StripsOf = typename Weights::template Strips<Tile::kColumns / static_cast<int>(Int8Panels::kColumns)>;

/// `Tile` has: V (a type of vec.h), kRows and kColumns (of the product), kBlockRows and kBlockKiB (largest block of x),
/// kStep (largest step of the depth), kEven (tiles of equal height), Session (held while a thread works), kSigned (sums
/// are of the weights themselves, without their offset), kLayout (layout of a rounded y, see LinearStripes), and
///   multiply(n_row, x, x_stride, strips, depth, sums, add, between)
///     sums [kColumns] x n_row <= kRows, += if `add`. `strips` are ExpandedStrips or the panels' own Strips. It may
///     read and write rows up to kRows.
/// kBeside: a separate unit computes products. multiply calls between() once for every 64 of the depth, before it
/// writes sums; between() finishes some rows of the previous tile.
/// kFirstExpands: the first tile of many rows expands weights to bytes while it multiplies, if registers suffice.
/// kPairs: an instruction takes two rows by two columns. The tile copies rows in pairs with pair(first, second, depth,
/// to) and rearranges weights of any width with expand(strips, depth, to). multiply gets the bytes of expand instead of
/// `strips`, and no between().
/// Panel: the tile's own format of weights for many rows, at most kSize bytes. expand(strips, depth, to) converts a
/// step to it, and multiply gets it instead of `strips`.
/// Compile a file that includes this with -ffp-contract=off, because each operation after the sums rounds separately.
template <class Tile, class Weights>
concept Int8Tile = requires {
  typename Tile::V::Int;
  typename Tile::Session;
  typename std::bool_constant<Tile::kEven && Tile::kBeside && Tile::kSigned>;
  typename std::integral_constant<RoundedLayout, Tile::kLayout>;
  requires Tile::kRows >
  0 && Tile::kBlockRows > 0 && Tile::kBlockKiB > 0;
  requires Tile::kColumns % Int8Panels::kColumns == 0 && Tile::kStep % kQuantizedUnit == 0;
}
&&requires(const std::byte* x, std::int64_t n, const StripsOf<Tile, Weights>& strips, std::byte* to, std::int32_t* sums,
           void (&between)()) {
  requires kTakesPairs<Tile> || requires { Tile::multiply(int{}, x, n, strips, n, sums, true, between); };
  requires !kTakesPairs<Tile> || requires {
    Tile::pair(x, x, n, to);
    Tile::expand(strips, n, to);
    Tile::multiply(int{}, x, n, to, n, sums, true);
  };
};

template <class Tile, class Weights>
requires Int8Tile<Tile, Weights>
class Int8Loop {
  static constexpr bool kPairs = kTakesPairs<Tile>, kOwnPanel = kHasPanel<Tile>;
  using V = typename Tile::V;
  using Stripes = LinearStripes<Tile, Tile::kLayout>;
  using Finish = typename Stripes::Finish;
  static constexpr std::int64_t kRows = Tile::kRows, kColumns = Tile::kColumns, kBlockRows = Tile::kBlockRows;
  static constexpr int kStrips = Tile::kColumns / static_cast<int>(Int8Panels::kColumns);
  using Numbers = StripsOf<Tile, Weights>;
  static constexpr std::int64_t kFewRows = 32;   // up to this many rows, the tile unpacks weights itself
  static constexpr std::int64_t kMinItems = 16;  // per thread, if there are that many
  static constexpr bool kPacked = !std::is_same_v<Weights, BytePanels>;
  static constexpr bool kFirstExpands = requires { Tile::kFirstExpands; };
  static constexpr std::int32_t kOffset = Tile::kSigned ? 0 : Weights::kOffset;

  static constexpr std::int64_t panel_size() {
    if constexpr (kOwnPanel) return Tile::Panel::kSize;
    return kPacked || kPairs ? Tile::kStep * kColumns : 1;
  }

  struct Scratch {
    // For kPairs: the first row of the copied block of x. Items of one block are consecutive, so a worker copies it
    // once.
    std::int64_t row;
    alignas(64) std::byte x[kPairs ? (Tile::kBlockKiB << 10) + (kRows + 1) * quantized_stride(kMaxPairedDepth) : 1];
    alignas(64) std::byte panel[panel_size()];
    alignas(64) std::int32_t sums[(kBlockRows + kRows) * kColumns];
    alignas(64) float gates[(kBlockRows + kRows) * kColumns];
    alignas(64) float scaled[kRows * kColumns];
  };

 public:
  /// The kernel table's row for this tile. The quantizer of x also computes the norm of x, of any width.
  static constexpr LinearKernel kernel(const char* name, bool (*supports)(const MatrixDesc& desc, Features use)) {
    return {
        .name = name,
        .packed_size = Weights::packed_size,
        .pack = Weights::pack,
        .supports = supports,
        .cut = cut,
        .run = run,
        .scratch_size = sizeof(Scratch),
        .max_norm = kAnyDepth,
        .rounded = Tile::kLayout,
        .max_rounded_depth = kAnyDepth,
        .quantize = [](const float* x, std::int64_t n, std::byte* to) { quantize_row<V>(x, n, to); },
    };
  }

 private:
  explicit Int8Loop(const LinearJob& job)
      : job_(job),
        block_rows_(even_block(job.n_row, block_rows(job.x_stride), kRows)),
        n_block_(ceil_div(job.n_row, block_rows_)),
        n_panel_(Stripes::n_panel(job)) {}

  /// Rows of x that stay in a cache while panels pass by.
  static std::int64_t block_rows(std::int64_t x_stride) {
    return min(kBlockRows, round_up((Tile::kBlockKiB << 10) / x_stride + 1, kRows));
  }

  static std::int64_t cut(LinearJob& job, int n_thread) {
    const Int8Loop loop(job);
    job.n_group = n_thread == 1 ? 1 : min(ceil_div(kMinItems * n_thread, loop.n_block_), loop.n_panel_);
    return loop.n_block_ * job.n_group;
  }

  /// An item: some panels by a block of rows.
  static void run(const LinearJob& job, std::int64_t item, Worker& worker) {
    [[maybe_unused]] const typename Tile::Session session;
    Int8Loop loop(job);
    const auto [scratch, kept] = worker.scratch_of<Scratch>(&job);
    loop.scratch_ = scratch;
    const std::int64_t row = item / job.n_group * loop.block_rows_, group = item % job.n_group;
    if constexpr (kPairs)
      if (!kept || scratch->row != row) loop.pair_rows(row, min(loop.block_rows_, job.n_row - row));
    for (std::int64_t panel = loop.n_panel_ * group / job.n_group; panel < loop.n_panel_ * (group + 1) / job.n_group;
         ++panel) {
      Stripe stripe = Stripes::of_panel(job, panel);
      stripe.row = row, stripe.n_row = min(loop.block_rows_, job.n_row - row), stripe.depth = job.d_in;
      stripe.gates = loop.scratch_->gates;
      if (job.gated) loop.sum(job.part[0], stripe, true);
      loop.sum(job.part[stripe.part], stripe, false);
    }
    loop.summed_.finish();
  }

  const std::byte* row_of(const Stripe& s, std::int64_t r) const { return job_.x + (s.row + r) * job_.x_stride; }

  void pair_rows(std::int64_t row, std::int64_t n_row) {
    scratch_->row = row;
    const std::byte* from = job_.x + row * job_.x_stride;
    for (std::int64_t r = 0; r < n_row; r += 2)
      Tile::pair(from + r * job_.x_stride, from + min(r + 1, n_row - 1) * job_.x_stride, quantized_depth(job_.d_in),
                 scratch_->x + r * job_.x_stride);
  }

  /// Finishes some rows of a tile whose sums are complete: writes gates or y.
  struct Summed {
    const Int8Loop* loop = nullptr;
    const LinearJob::Part* part = nullptr;
    Stripe s = {};
    bool gate = false;
    std::int64_t r = 0, n_row = 0, n_finished = 0;
    Finish to_y = {};

    VLA_INLINE void finish(std::int64_t n) {
      n = min(n, n_row - n_finished);
      if (n <= 0) return;
      float* scaled = gate ? s.gates + (r + n_finished) * kColumns : loop->scratch_->scaled + n_finished * kColumns;
      loop->scale(*part, s, r + n_finished, n, scaled);
      if (!gate) to_y(n_finished, n_finished + n);
      n_finished += n;
    }
    void finish() { finish(n_row); }
  };

  /// Sums the products in a panel's columns, and finishes each tile whose sums are complete.
  VLA_INLINE void sum(const LinearJob::Part& part, const Stripe& s, bool gate) {
    const std::int64_t n_tile = ceil_div(s.n_row, kRows), depth = quantized_depth(job_.d_in);
    const std::int64_t step = even_block(depth, Tile::kStep, kQuantizedUnit);
    const std::byte* strips = part.weight + s.column / Int8Panels::kColumns * Weights::strip_size(job_.d_in);
    for (std::int64_t k = 0; k < depth; k += step) {
      const Numbers numbers(strips, job_.d_in, k);
      const std::int64_t d = min(step, depth - k);
      bool expands = false;
      if constexpr (kPairs) {
        Tile::expand(numbers, d, scratch_->panel);
      } else if constexpr (kOwnPanel) {
        expands = job_.n_row > kFewRows;
        if (expands) Tile::expand(numbers, d, scratch_->panel);
      } else if constexpr (kPacked) {
        expands = job_.n_row > kFewRows;
        if (expands && !kFirstExpands) expand<typename V::Int, kStrips>(numbers, 0, d, scratch_->panel);
      }
      for (std::int64_t t = 0; t < n_tile; ++t) {
        const std::int64_t r = Stripes::first_row(s.n_row, t), n_row = Stripes::first_row(s.n_row, t + 1) - r;
        std::int32_t* sums = scratch_->sums + r * kColumns;
        if (k + d == depth && !gate) Stripes::fetch(job_, s, r, n_row);
        const std::int64_t n_finish = ceil_div(kRows * 64, d);
        const auto multiply = [&](const auto& from) VLA_LAMBDA {
          Tile::multiply(static_cast<int>(n_row), row_of(s, r) + k, job_.x_stride, from, d, sums, k > 0,
                         [&]() VLA_LAMBDA { summed_.finish(n_finish); });
        };
        if constexpr (kPairs)
          Tile::multiply(static_cast<int>(n_row), scratch_->x + r * job_.x_stride + 2 * k, job_.x_stride,
                         scratch_->panel, d, sums, k > 0);
        else if (!expands)
          multiply(numbers);
        else if constexpr (kOwnPanel)
          multiply(typename Tile::Panel{scratch_->panel});
        else if constexpr (kFirstExpands && kPacked)
          t == 0 ? multiply(ExpandingStrips<kStrips, Numbers>{scratch_->panel, numbers})
                 : multiply(ExpandedStrips<kStrips, Numbers>{scratch_->panel, numbers});
        else if constexpr (kPacked)
          multiply(ExpandedStrips<kStrips, Numbers>{scratch_->panel, numbers});
        if (k + d < depth) continue;
        summed_ = {.loop = this,
                   .part = &part,
                   .s = s,
                   .gate = gate,
                   .r = r,
                   .n_row = n_row,
                   .to_y = Finish(job_, s, scratch_->scaled, r, n_row)};
        if constexpr (!Tile::kBeside) summed_.finish();
      }
    }
  }

  VLA_INLINE void scale(const LinearJob::Part& part, const Stripe& s, std::int64_t r, std::int64_t n_row,
                        float* to) const {
    for (std::int64_t i = 0; i < n_row; ++i, ++r)
      scale_sums<V, Weights, kColumns, kOffset>(part, s, row_scale(row_of(s, r), job_.d_in),
                                                scratch_->sums + r * kColumns, to + i * kColumns);
  }

  const LinearJob& job_;
  Scratch* scratch_ = nullptr;
  Summed summed_;  // the previous tile
  const std::int64_t block_rows_, n_block_, n_panel_;
};

}  // namespace vla::kernels
