// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/linear_panels.h"
#include "kernels/linear_stripe.h"

/// The loops around tile registers, which multiply so fast that everything else must be done beside them.
///
/// x is rounded to bf16, as PyTorch rounds the activations of a bf16 layer, and lies in tiles (rounded.h): where the
/// product before left it so, as it is, else as a copy of some rows in the second cache. A block of rows is multiplied
/// by one panel after the other, a step of the depth at a time, which stays in the first cache. What follows the sums
/// of a square of 32 x 32 is done some rows at a time between the instructions that multiply the next square.
namespace vla::kernels {

/// `Tile` has: V (a type of vec.h), Session (held while a thread works), and
///   copy(from, n, to)                 n <= 32 numbers of x, and zeros up to 32
///   store_rounded(to, vector, left)   y as bf16
///   multiply(half, x, panel, n_square, c, add, between)
///     a square c of sums, += where `add`, or its first 16 rows; calls between() n_square times
template <class Tile>
class TileLoop {
  using V = typename Tile::V;
  using X = std::uint16_t;
  struct Shape : Tile {
    static constexpr int kRows = kSquare, kColumns = kSquare;
    static constexpr bool kEven = false;
  };
  using Layout = Panels<kSquare>;
  using Stripes = LinearStripes<Shape, RoundedLayout::tiles>;
  using Finish = typename Stripes::Finish;

  static constexpr std::int64_t kMaxRows = 512;     // of a block: the more, the fewer times a panel is read
  static constexpr std::int64_t kMaxX = 768 << 10;  // numbers of x in a block, most of the second cache
  static constexpr std::int64_t kMaxDepth = 2048;   // of such a block
  static constexpr std::int64_t kStep = 768;        // of the depth: a panel's step fills the first cache
  static constexpr std::int64_t kGroupPanels = 16;  // of an item, where the depth takes several blocks
  static constexpr std::int64_t kMinItems = 16;     // for each thread, where there are so many

  using Sums = float[kMaxRows * kSquare];
  struct Scratch {
    std::int64_t row, depth;  // which rows of x the copy holds, and from which depth on
    alignas(64) X x[kMaxX];
    alignas(64) float normed[kMaxDepth];
    alignas(64) float square[2][kSquare * kSquare];  // sums that no other step adds to, in turn
    alignas(64) Sums sums[kGroupPanels];             // of panels whose depth takes several steps
    alignas(64) Sums gates[kGroupPanels];
  };

 public:
  /// The row of the table that this tile makes.
  static constexpr LinearKernel kernel(const char* name, bool (*supports)(const MatrixDesc& desc, Isa isa),
                                       const LinearKernel* few = nullptr, std::int64_t max_few = 0) {
    return {name,
            Layout::packed_size,
            Layout::pack,
            supports,
            cut,
            run,
            sizeof(Scratch),
            kMaxDepth,
            [](std::int64_t) { return RoundedLayout::tiles; },
            few,
            max_few};
  }

 private:
  static std::int64_t cut(LinearJob& job, int n_thread) {
    const TileLoop loop(job);
    const bool copies_again = !loop.whole_depth() && job.x_type != DType::bf16;
    const std::int64_t min_panels = copies_again ? kGroupPanels : 1;
    const std::int64_t wanted = n_thread == 1 ? 1 : ceil_div(kMinItems * n_thread, loop.n_block_);
    job.n_group = min(wanted, ceil_div(loop.n_panel_, min_panels));
    const std::int64_t room = loop.whole_depth() ? 1 : ceil_div(loop.n_panel_, kGroupPanels);
    if (job.n_group < room) job.n_group = room;
    return loop.n_block_ * job.n_group;
  }

  static void run(const LinearJob& job, std::int64_t item, Worker& worker) {
    [[maybe_unused]] const typename Tile::Session session;
    TileLoop loop(job);
    const auto [scratch, kept] = worker.scratch_of<Scratch>(&job);
    if (!kept) scratch->row = -1;
    loop.scratch_ = scratch;
    loop.item(item);
  }

  explicit TileLoop(const LinearJob& job)
      : job_(job),
        block_depth_(even_block(job.d_in, max_depth(job.n_row), kSquare)),
        block_rows_(even_block(job.n_row, min(kMaxRows, kMaxX / block_depth_ / kSquare * kSquare), kSquare)),
        n_block_(ceil_div(job.n_row, block_rows_)),
        n_panel_(Stripes::n_panel(job)) {}

  /// Few rows leave room for a greater depth.
  static std::int64_t max_depth(std::int64_t n_row) {
    const std::int64_t depth = kMaxX / round_up(n_row, kSquare) / kSquare * kSquare;
    return depth > kMaxDepth ? depth : kMaxDepth;
  }
  bool whole_depth() const { return block_depth_ >= job_.d_in; }

  /// Some panels by a block of rows.
  void item(std::int64_t i) {
    const std::int64_t block = i / job_.n_group, group = i % job_.n_group;
    row_ = block * block_rows_, n_row_ = min(block_rows_, job_.n_row - row_);
    const std::int64_t begin = n_panel_ * group / job_.n_group, end = n_panel_ * (group + 1) / job_.n_group;
    for (k_ = 0; k_ < job_.d_in; k_ += block_depth_) {
      depth_ = min(block_depth_, job_.d_in - k_);
      if (job_.x_type != DType::bf16) take_rows();
      for (std::int64_t panel = begin; panel < end; ++panel) multiply(panel, whole_depth() ? 0 : panel - begin);
    }
    finish_pending();
  }

  /// Copies the block of x, unless an item before left it here.
  void take_rows() {
    if (row_ == scratch_->row && k_ == scratch_->depth) return;
    scratch_->row = row_, scratch_->depth = k_;
    for (std::int64_t r = 0; r < n_row_; ++r) {
      const float* row = reinterpret_cast<const float*>(job_.x) + (row_ + r) * job_.x_stride;
      const float* x = job_.norm(row, job_.d_in, scratch_->normed) + k_;
      for (std::int64_t i = 0; i < depth_; i += kSquare)
        Tile::copy(x + i, min(kSquare, depth_ - i), scratch_->x + place_in_tiles(r, i, depth_));
    }
  }

  /// The square of x that begins at row r and number k of the block.
  const X* square_of_x(std::int64_t r, std::int64_t k) const {
    if (job_.x_type != DType::bf16) return scratch_->x + place_in_tiles(r, k, depth_);
    return reinterpret_cast<const X*>(job_.x) + place_in_tiles(row_ + r, k_ + k, job_.d_in);
  }

  /// One panel, and its gate's. The stripe's depth is all of it, since no partial sum goes to y.
  void multiply(std::int64_t panel, std::int64_t slot) {
    Stripe s = Stripes::of_panel(job_, panel);
    s.row = row_, s.n_row = n_row_, s.depth = job_.d_in, s.gates = scratch_->gates[slot];
    if (job_.gated) sum(job_.part[0], s, s.gates, false);
    sum(job_.part[s.part], s, scratch_->sums[slot], k_ + depth_ == job_.d_in);
  }

  /// sums (+)= the block of x times a panel. `finish`: these were the last, y is made of them.
  void sum(const LinearJob::Part& part, const Stripe& s, float* sums, bool finish) {
    const std::int64_t depth = round_up(depth_, kSquare), step = even_block(depth, kStep, kSquare);
    const std::int64_t n_tile = ceil_div(n_row_, kSquare);
    const bool in_turn = finish && step == round_up(job_.d_in, kSquare);
    const std::byte* panel = part.weight + s.column / kSquare * Layout::size(part.type, round_up(job_.d_in, kSquare)) +
                             Layout::size(part.type, k_);
    for (std::int64_t k = 0; k < depth; k += step) {
      const std::int64_t d = min(step, depth - k), size = Layout::size(part.type, d);
      const std::byte* next = panel + size;
      const bool is_last = finish && k + d == depth;
      for (std::int64_t t = 0; t < n_tile; ++t) {
        const std::int64_t r = t * kSquare, n_row = min(kSquare, n_row_ - r);
        float* c = in_turn ? scratch_->square[i_square_++ % 2] : sums + r * kSquare;
        Between between(*this, d / kSquare, next + size * t / n_tile, size / n_tile);
        if (is_last) between.ask_for(s, r, n_row);
        Tile::multiply(n_row <= kSquare / 2, square_of_x(r, k), panel, d / kSquare, c, k_ + k > 0, between);
        finish_pending();
        if (is_last) pending_ = Finish(job_, s, c, r, n_row);
      }
      panel = next;
    }
  }

  void finish_pending() {
    if (n_finished_ < pending_.n_row()) pending_(n_finished_, pending_.n_row());
    pending_ = {}, n_finished_ = 0;
  }

  /// What is done between the instructions that multiply a square: rows of the square before are finished, and memory
  /// that will be needed soon is asked for.
  class Between {
   public:
    VLA_INLINE Between(TileLoop& loop, std::int64_t n_call, const std::byte* next, std::int64_t size)
        : loop_(loop),
          n_finish_(ceil_div(loop.pending_.n_row(), n_call)),
          n_line_(ceil_div(size, 64 * n_call)),
          next_(next) {}

    /// What this square's y and residual will need.
    VLA_INLINE void ask_for(const Stripe& s, std::int64_t r, std::int64_t n_row) {
      if (loop_.job_.y_type == DType::f32) stripe_ = &s, row_ = r, end_ = r + n_row;
    }

    VLA_INLINE void operator()() {
      for (std::int64_t line = 0; line < n_line_; ++line, next_ += 64) __builtin_prefetch(next_, 0, 2);
      for (int i = 0; i < kAsked && row_ < end_; ++i, ++row_) Stripes::fetch(loop_.job_, *stripe_, row_, 1);
      if (n_finish_ == 0) return;
      const std::int64_t begin = loop_.n_finished_, end = min(begin + n_finish_, loop_.pending_.n_row());
      if (begin < end) loop_.pending_(begin, end), loop_.n_finished_ = end;
    }

   private:
    static constexpr int kAsked = 2;  // rows at a time
    TileLoop& loop_;
    const std::int64_t n_finish_, n_line_;
    const std::byte* next_;
    const Stripe* stripe_ = nullptr;
    std::int64_t row_ = 0, end_ = 0;
  };

  const LinearJob& job_;
  Scratch* scratch_ = nullptr;
  const std::int64_t block_depth_, block_rows_, n_block_, n_panel_;
  std::int64_t row_ = 0, n_row_ = 0, k_ = 0, depth_ = 0;  // of the block at hand
  std::int64_t i_square_ = 0;
  Finish pending_;  // of the square before
  std::int64_t n_finished_ = 0;
};

}  // namespace vla::kernels
