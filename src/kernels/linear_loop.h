// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <type_traits>

#include "kernels/linear_panels.h"
#include "kernels/linear_stripe.h"

/// The loops around a tile: items, cache blocking, edges, epilogue.
///
/// A tile multiplies a few rows of x by the columns of a panel (linear_panels.h) over some of the depth d_in. A block
/// of rows of x is first copied into L2 with a fixed stride, so that the inner loop does not depend on their addresses
/// or width. Then the block is multiplied by one panel after the other, a step of the depth at a time; the step stays
/// in L1 while all rows of the block are multiplied by it. Source of the method: Goto and van de Geijn, Anatomy of
/// High-Performance Matrix Multiplication (2008).
namespace vla::kernels {

/// The part of a panel that is multiplied next.
struct Prefetch {
  const std::byte* from;
  std::int64_t size;
};

/// `Tile` has: V (a type of vec.h), X (the type that x becomes), kRows and kColumns (of the tile), kBlockRows (rows of
/// a block of x), kMaxDepth and kXStride (largest depth and stride of the block's rows), kStep (largest step of the
/// depth), kRounds (x becomes bf16), kEven (tiles of equal height), and
///   place(r, k)                       offset of element k of row r in the block, if rows are not contiguous
///   copy(from, n, to)                 copies n elements of x, zeros up to a multiple of 32; if kRounds also from bf16
///   store_rounded(to, vector, left)   stores y as bf16, if kRounds
///   multiply(type, n_row, x, panel, depth, c, add, ahead)
///     c [kColumns] x n_row <= kRows, += if `add`; prefetches `ahead`
template <class Tile>
concept LinearTile = requires(const float* from, std::int64_t n, typename Tile::X* to, const typename Tile::X* x,
                              const std::byte* panel, float* c, const Prefetch& ahead) {
  typename Tile::V::Float;
  typename std::bool_constant<Tile::kEven>;
  requires Tile::kMaxDepth % kPanelDepth == 0 && Tile::kXStride > 0;
  requires Tile::kStep % kPanelDepth == 0 && Tile::kBlockRows % Tile::kRows == 0;
  Tile::copy(from, n, to);
  Tile::multiply(DType::f32, int{Tile::kRows}, x, panel, n, c, true, ahead);
}
&&(!Tile::kRounds ||
   requires(const typename Tile::X* from, std::int64_t n, typename Tile::X* to, typename Tile::V::Float vector) {
     Tile::copy(from, n, to);
     Tile::store_rounded(to, vector, n);
   });

template <LinearTile Tile>
class LinearLoop {
  using V = typename Tile::V;
  using X = typename Tile::X;
  using Layout = Panels<Tile::kColumns>;
  static constexpr RoundedLayout kLayout = Tile::kRounds ? RoundedLayout::rows : RoundedLayout::none;
  using Stripes = LinearStripes<Tile, kLayout>;
  static constexpr std::int64_t kRows = Tile::kRows, kColumns = Tile::kColumns, kBlockRows = Tile::kBlockRows;
  static constexpr std::int64_t kGateColumns = 16 * kColumns;  // per item, if the depth takes more than one block
  static constexpr std::int64_t kMinItems = 16;                // per thread, if there are that many

  struct Scratch {
    // First row and first depth of the copied block of x. Items of one block are consecutive, so a worker copies it
    // once.
    std::int64_t row, depth;
    alignas(64) X x[(kBlockRows + kRows) * Tile::kXStride];  // a tile may read rows after the block
    alignas(64) float row_of_x[Tile::kMaxDepth];             // a row of x after its norm, or a window's elements
    alignas(64) float sums[(kBlockRows + kRows) * kColumns];
    alignas(64) float gates[(kBlockRows + kRows) * kGateColumns];
  };

 public:
  /// The kernel table's row for this tile.
  static constexpr LinearKernel kernel(const char* name, bool (*supports)(const MatrixDesc& desc, Features use),
                                       const LinearKernel* small_batch = nullptr, std::int64_t max_small_batch = 0) {
    return {
        .name = name,
        .packed_size = Layout::packed_size,
        .pack = Layout::pack,
        .supports = supports,
        .cut = cut,
        .run = run,
        .scratch_size = sizeof(Scratch),
        .max_norm = Tile::kMaxDepth,
        .rounded = kLayout,
        .max_rounded_depth = Tile::kMaxDepth,
        .small_batch = small_batch,
        .max_small_batch = max_small_batch,
        .takes_windows = true,
    };
  }

 private:
  static std::int64_t cut(LinearJob& job, int n_thread) {
    const LinearLoop loop(job);
    // A group whose depth takes several blocks copies x again for each, so it needs several panels to amortize that.
    const std::int64_t min_panels = loop.whole_depth() ? 1 : 16;
    job.n_group =
        n_thread == 1 ? 1 : min(ceil_div(kMinItems * n_thread, loop.n_block_), ceil_div(loop.n_panel_, min_panels));
    const std::int64_t room = ceil_div(loop.n_panel_, kGateColumns / kColumns);
    if (job.gated && !loop.whole_depth() && job.n_group < room) job.n_group = room;
    return loop.n_block_ * job.n_group;
  }

  static void run(const LinearJob& job, std::int64_t item, Worker& worker) {
    LinearLoop loop(job);
    const auto [scratch, kept] = worker.scratch_of<Scratch>(&job);
    if (!kept) scratch->row = -1;
    loop.scratch_ = scratch;
    loop.item(item);
  }

  explicit LinearLoop(const LinearJob& job)
      : job_(job),
        block_rows_(even_block(job.n_row, kBlockRows, kRows)),
        n_block_(ceil_div(job.n_row, block_rows_)),
        block_depth_(even_block(job.d_in, max_depth(job), kPanelDepth)),
        n_panel_(Stripes::n_panel(job)) {}

  static VLA_INLINE std::int64_t place(std::int64_t r, std::int64_t k) {
    if constexpr (requires { Tile::place(r, k); })
      return Tile::place(r, k);
    else
      return r * Tile::kXStride + k;
  }

  /// The largest depth of a block. A block of one row may be deeper, so that a panel is read from one end to the other.
  static std::int64_t max_depth(const LinearJob& job) {
    constexpr std::int64_t kOneRow = 8 * Tile::kMaxDepth;
    static_assert(kOneRow <= kBlockRows / 2 * Tile::kXStride);
    return job.n_row == 1 && job.window.size == 0 ? kOneRow : Tile::kMaxDepth;
  }

  bool whole_depth() const { return block_depth_ >= job_.d_in; }

  /// An item: some panels by a block of rows.
  void item(std::int64_t i) {
    const std::int64_t block = i / job_.n_group, group = i % job_.n_group;
    const std::int64_t row = block * block_rows_, n_row = min(block_rows_, job_.n_row - row);
    const std::int64_t begin = n_panel_ * group / job_.n_group, end = n_panel_ * (group + 1) / job_.n_group;
    for (std::int64_t k = 0; k < job_.d_in; k += block_depth_) {
      const std::int64_t depth = min(block_depth_, job_.d_in - k);
      take_rows(row, n_row, k, depth);
      for (std::int64_t panel = begin; panel < end; ++panel) {
        Stripe stripe = Stripes::of_panel(job_, panel);
        stripe.row = row, stripe.n_row = n_row, stripe.k = k, stripe.depth = depth;
        stripe.gates = scratch_->gates + (whole_depth() ? 0 : panel - begin) * (kBlockRows + kRows) * kColumns;
        multiply(stripe, Stripes::behind(job_, begin, end, panel, k, depth));
      }
    }
  }

  /// Copies rows [row, row + n_row) of x, starting at depth k, unless the scratch memory has them from an earlier item.
  void take_rows(std::int64_t row, std::int64_t n_row, std::int64_t k, std::int64_t depth) {
    if (row == scratch_->row && k == scratch_->depth) return;
    scratch_->row = row, scratch_->depth = k;
    for (std::int64_t r = 0; r < n_row; ++r) {
      X* to = scratch_->x + place(r, 0);
      if (job_.window.size > 0) {
        take_place(row + r, k, depth, to);
        continue;
      }
      const std::int64_t from = (row + r) * job_.x_stride;
      if (Tile::kRounds && job_.x_type == DType::bf16)
        Tile::copy(reinterpret_cast<const X*>(job_.x) + from + k, depth, to);
      else
        Tile::copy(job_.norm(reinterpret_cast<const float*>(job_.x) + from, job_.d_in, scratch_->row_of_x) + k, depth,
                   to);
    }
  }

  /// Copies the window's elements at a place, starting at depth k; directly into the block if X is float.
  void take_place(std::int64_t place, std::int64_t k, std::int64_t depth, X* to) {
    const auto* images = reinterpret_cast<const float*>(job_.x);
    if constexpr (std::is_same_v<X, float>) {
      job_.window.copy(images, place, k, depth, to);
      std::memset(to + depth, 0, static_cast<std::size_t>(round_up(depth, kPanelDepth) - depth) * sizeof(float));
    } else {
      job_.window.copy(images, place, k, depth, scratch_->row_of_x);
      Tile::copy(scratch_->row_of_x, depth, to);
    }
  }

  /// y of the stripe (+)= the block of x times the panel; `next` is prefetched. The epilogue runs while a tile's sums
  /// are in L1.
  void multiply(const Stripe& s, const std::byte* next) {
    const LinearJob::Part& part = job_.part[s.part];
    if (job_.gated)
      sum(
          job_.part[0], s, s.gates, s.k > 0, Stripes::panel_of(job_, part, s.column, s.k), [](auto, auto) {},
          [](auto, auto) {});
    sum(
        part, s, scratch_->sums, false, next,
        [&](std::int64_t r, std::int64_t n_row) { Stripes::fetch(job_, s, r, n_row); },
        [&](std::int64_t r, std::int64_t n_row) { Stripes::finish(job_, s, scratch_->sums + r * kColumns, r, n_row); });
  }

  /// sums [kColumns] x n_row (+)= the block of x times a panel. `before` and `after` are called around the last step of
  /// each tile with the tile's first row and number of rows.
  template <class Before, class After>
  VLA_INLINE void sum(const LinearJob::Part& part, const Stripe& s, float* sums, bool add, const std::byte* next_panel,
                      const Before& before, const After& after) {
    const std::int64_t depth = round_up(s.depth, kPanelDepth), step = even_block(depth, Tile::kStep, kPanelDepth);
    const std::int64_t n_tile = ceil_div(s.n_row, kRows);
    const std::byte* panel = Stripes::panel_of(job_, part, s.column, s.k);
    for (std::int64_t k = 0; k < depth; k += step) {
      const std::int64_t d = min(step, depth - k), size = Layout::size(part.type, d);
      const std::byte* next = k + d < depth ? panel + size : next_panel;  // prefetched during this step
      for (std::int64_t t = 0; t < n_tile; ++t) {
        const std::int64_t r = Stripes::first_row(s.n_row, t), n_row = Stripes::first_row(s.n_row, t + 1) - r;
        if (k + d == depth) before(r, n_row);
        Tile::multiply(part.type, static_cast<int>(n_row), scratch_->x + place(r, k), panel, d, sums + r * kColumns,
                       add || k > 0, {next + size * t / n_tile, size / n_tile});
        if (k + d == depth) after(r, n_row);
      }
      panel = next;
    }
  }

  const LinearJob& job_;
  Scratch* scratch_ = nullptr;
  const std::int64_t block_rows_, n_block_, block_depth_, n_panel_;
};

}  // namespace vla::kernels
