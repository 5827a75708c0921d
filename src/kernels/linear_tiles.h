// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/linear_panels.h"
#include "kernels/linear_stripe.h"

/// The loops around tile registers, which multiply so fast that all other work must overlap with products.
///
/// x is rounded to bf16, as PyTorch rounds the activations of a bf16 layer, and stored in tiles (rounded.h). If the
/// previous product stored x in tiles, it is read in place, else some rows are copied to L2. A block of rows is
/// multiplied by one panel after the other, a step of the depth at a time; the step stays in L1. The epilogue of a
/// square of 32 x 32 sums runs a few rows at a time between the instructions that multiply later squares.
namespace vla::kernels {

/// `Tile` has: V (a type of vec.h), Session (held while a thread works), and
///   copy(from, n, to)                 copies n <= 32 elements of x, padded with zeros to 32
///   store_rounded(to, vector, left)   stores y as bf16; also (to, vector, vector) if 32 elements are two vectors
///   multiply(half, x, panel, n_square, c, add, between)
///     a square c of sums, or only its first 16 rows if `half`; += if `add`; calls between() n_square times
template <class Tile>
concept SquareTile = requires(const float* from, std::int64_t n, std::uint16_t* to, typename Tile::V::Float vector,
                              const std::uint16_t* x, const std::byte* panel, float* c, void (&between)()) {
  typename Tile::Session;
  Tile::copy(from, n, to);
  Tile::store_rounded(to, vector, n);
  Tile::multiply(true, x, panel, n, c, true, between);
};

template <SquareTile Tile>
class TileLoop {
  using V = typename Tile::V;
  using X = std::uint16_t;
  struct Shape : Tile {
    static constexpr int kRows = kTileSide, kColumns = kTileSide;
    static constexpr bool kEven = false;
  };
  using Layout = Panels<kTileSide>;
  using Stripes = LinearStripes<Shape, RoundedLayout::tiles>;
  using Finish = typename Stripes::Finish;

  static constexpr std::int64_t kMaxRows = 512;     // rows of a block: more rows read a panel fewer times
  static constexpr std::int64_t kMaxX = 512 << 10;  // elements of x in a block, half of L2
  static constexpr std::int64_t kMaxDepth = 2048;   // up to this depth, a block has the whole depth
  static constexpr std::int64_t kStep = 512;        // step of the depth: a panel's step stays in L1
  static constexpr std::int64_t kRowsAhead = 4;     // prefetch distance in rows of x and y
  static constexpr std::int64_t kMinItems = 16;     // per thread, if there are that many
  // A greater depth takes several blocks. Between blocks an item keeps the sums of its group of panels. Each group
  // reads the whole block of x.
  static constexpr std::int64_t kSplitDepth = 1024, kSplitRows = 256, kMinGroup = 4, kMaxGroup = 24;
  static constexpr std::int64_t kMinSplitItems = 8;
  static constexpr std::int64_t kMaxSums = kMaxGroup * kSplitRows * kTileSide;
  // Every block of rows reads all weights from memory, unless threads multiply the same panels at the same time. If
  // they do, blocks may be larger, and the threads share the rows evenly.
  static constexpr std::int64_t kFarWeights = 16 << 20, kFarX = 640 << 10, kFarRows = 320;

  struct Scratch {
    std::int64_t row, depth;  // first row and first depth of the copied block of x
    alignas(64) X x[kFarX];
    alignas(64) float row_of_x[kMaxDepth];  // a row of x after its norm, or a window's elements
    alignas(64) float sums[kMaxSums];       // sums of a panel and the previous one, or of a group of panels
    alignas(64) float gates[kMaxSums];
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
        .max_norm = kMaxDepth,
        .rounded = RoundedLayout::tiles,
        .max_rounded_depth = kAnyDepth,
        .small_batch = small_batch,
        .max_small_batch = max_small_batch,
        .l2_elements = kMaxX,
        .takes_windows = true,
    };
  }

 private:
  static std::int64_t cut(LinearJob& job, int n_thread) {
    job.block_rows = block_rows(job, n_thread);
    const TileLoop loop(job);
    const bool whole = loop.whole_depth();
    const std::int64_t n_item = n_thread == 1 ? 1 : n_thread * (whole ? kMinItems : kMinSplitItems);
    job.n_group = min(ceil_div(n_item, loop.n_block_), ceil_div(loop.n_panel_, whole ? 1 : kMinGroup));
    const std::int64_t room = whole ? 1 : ceil_div(loop.n_panel_, kMaxSums / (job.block_rows * kTileSide));
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
        block_depth_(has_whole_depth(job) ? job.d_in : even_block(job.d_in, kSplitDepth, kTileSide)),
        block_rows_(job.block_rows),
        n_block_(ceil_div(job.n_row, block_rows_)),
        n_panel_(Stripes::n_panel(job)) {}

  /// Whether a block has the whole depth. Fewer rows allow a greater depth.
  static bool has_whole_depth(const LinearJob& job) {
    return job.d_in <= kMaxDepth || job.d_in <= kMaxX / round_up(job.n_row, kTileSide) / kTileSide * kTileSide;
  }
  bool whole_depth() const { return block_depth_ >= job_.d_in; }

  static std::int64_t block_rows(const LinearJob& job, int n_thread) {
    const auto n_block = [&](std::int64_t max_x, std::int64_t max_split_rows) {
      const std::int64_t max_rows = min(kMaxRows, max_x / round_up(job.d_in, kTileSide) / kTileSide * kTileSide);
      return ceil_div(job.n_row, has_whole_depth(job) ? max_rows : max_split_rows);
    };
    std::int64_t n = n_block(kMaxX, kSplitRows), size = 0;
    for (int i = 0; i < job.n_part; ++i)
      size += Layout::size(job.part[i].type, job.d_in) * job.part[i].d_out / kTileSide;
    if (n > 1 && size >= kFarWeights)
      for (n = n_block(kFarX, kFarRows); n % n_thread != 0 && n_thread % n != 0;) ++n;
    return n == 0 ? kTileSide : round_up(ceil_div(job.n_row, n), kTileSide);
  }

  /// An item: some panels by a block of rows.
  void item(std::int64_t i) {
    const std::int64_t block = i / job_.n_group, group = i % job_.n_group;
    row_ = block * block_rows_, n_row_ = min(block_rows_, job_.n_row - row_);
    const std::int64_t begin = n_panel_ * group / job_.n_group, end = n_panel_ * (group + 1) / job_.n_group;
    for (k_ = 0; k_ < job_.d_in; k_ += block_depth_) {
      depth_ = min(block_depth_, job_.d_in - k_);
      if (job_.x_type != DType::bf16) take_rows();
      n_finish_ = ceil_div(kTileSide * kTileSide, depth_ * (job_.gated ? 2 : 1));
      for (std::int64_t panel = begin; panel < end; ++panel)
        multiply(panel, (whole_depth() ? panel % 2 : panel - begin) * block_rows_ * kTileSide,
                 Stripes::behind(job_, begin, end, panel, k_, depth_));
    }
    finish_summed();
  }

  /// Copies the block of x, unless the scratch memory has it from an earlier item.
  void take_rows() {
    if (row_ == scratch_->row && k_ == scratch_->depth) return;
    scratch_->row = row_, scratch_->depth = k_;
    if (job_.window.size > 0) return take_places();
    for (std::int64_t r = 0; r < n_row_; ++r) {
      const float* row = reinterpret_cast<const float*>(job_.x) + (row_ + r) * job_.x_stride;
      for (std::int64_t i = k_; i < k_ + depth_; i += 16) __builtin_prefetch(row + kRowsAhead * job_.x_stride + i);
      const float* x = job_.norm(row, job_.d_in, scratch_->row_of_x) + k_;
      for (std::int64_t i = 0; i < depth_; i += kTileSide)
        Tile::copy(x + i, min(kTileSide, depth_ - i), scratch_->x + place_in_tiles(r, i, depth_));
    }
  }

  /// The same for images under a window.
  void take_places() {
    for (std::int64_t r = 0; r < n_row_; ++r)
      for (std::int64_t i = 0; i < depth_; i += kMaxDepth) {
        const std::int64_t n = min(kMaxDepth, depth_ - i);
        job_.window.copy(reinterpret_cast<const float*>(job_.x), row_ + r, k_ + i, n, scratch_->row_of_x);
        for (std::int64_t j = 0; j < n; j += kTileSide)
          Tile::copy(scratch_->row_of_x + j, min(kTileSide, n - j), scratch_->x + place_in_tiles(r, i + j, depth_));
      }
  }

  /// The square of x at row r and element k of the block.
  const X* square_of_x(std::int64_t r, std::int64_t k) const {
    if (job_.x_type != DType::bf16) return scratch_->x + place_in_tiles(r, k, depth_);
    return reinterpret_cast<const X*>(job_.x) + place_in_tiles(row_ + r, k_ + k, job_.d_in);
  }

  /// Multiplies one panel, and its gate's, with sums in scratch memory; `next` is prefetched. The stripe's depth is the
  /// whole depth, since y never holds partial sums.
  void multiply(std::int64_t panel, std::int64_t place, const std::byte* next) {
    Stripe s = Stripes::of_panel(job_, panel);
    s.row = row_, s.n_row = n_row_, s.depth = job_.d_in, s.gates = scratch_->gates + place;
    const LinearJob::Part& part = job_.part[s.part];
    if (job_.gated) sum(job_.part[0], s, s.gates, Stripes::panel_of(job_, part, s.column, k_), false);
    sum(part, s, scratch_->sums + place, next, k_ + depth_ == job_.d_in);
  }

  /// sums (+)= the block of x times a panel. `finish`: the sums are complete and y is computed from them.
  void sum(const LinearJob::Part& part, const Stripe& s, float* sums, const std::byte* next_panel, bool finish) {
    const std::int64_t depth = round_up(depth_, kTileSide), step = even_block(depth, kStep, kTileSide);
    const std::int64_t n_tile = ceil_div(n_row_, kTileSide);
    const std::byte* panel = Stripes::panel_of(job_, part, s.column, k_);
    for (std::int64_t k = 0; k < depth; k += step) {
      const std::int64_t d = min(step, depth - k), size = Layout::size(part.type, d);
      const std::byte* next = k + d < depth ? panel + size : next_panel;
      const bool is_last = finish && k + d == depth;
      for (std::int64_t t = 0; t < n_tile; ++t) {
        const std::int64_t r = t * kTileSide, n_row = min(kTileSide, n_row_ - r);
        Between between(*this, d / kTileSide, next + size * t / n_tile, size / n_tile);
        Tile::multiply(n_row <= kTileSide / 2, square_of_x(r, k), panel, d / kTileSide, sums + r * kTileSide,
                       k_ + k > 0, between);
        if (!is_last) continue;
        if (t == 0) finish_summed(), finish_ = Finish(job_, s, sums, 0, n_row_), n_finished_ = 0;
        n_summed_ = r + n_row;
      }
      panel = next;
    }
  }

  void finish_summed() {
    if (n_finished_ < n_summed_) finish_(n_finished_, n_summed_);
    n_finished_ = n_summed_;
  }

  /// Work between the instructions that multiply a square: finishes rows of earlier squares and prefetches. Each call
  /// for a panel finishes about the same number of rows.
  class Between {
   public:
    VLA_INLINE Between(TileLoop& loop, std::int64_t n_call, const std::byte* next, std::int64_t size)
        : loop_(loop), n_line_(ceil_div(size, 64 * n_call)), next_(next) {}

    VLA_INLINE void operator()() {
      for (std::int64_t line = 0; line < n_line_; ++line, next_ += 64) __builtin_prefetch(next_, 0, 2);
      const std::int64_t begin = loop_.n_finished_, end = min(begin + loop_.n_finish_, loop_.n_summed_);
      if (begin == end) return;
      loop_.finish_(begin, end), loop_.n_finished_ = end;
      loop_.finish_.fetch(begin + kRowsAhead, end + kRowsAhead);
    }

   private:
    TileLoop& loop_;
    const std::int64_t n_line_;
    const std::byte* next_;
  };

  const LinearJob& job_;
  Scratch* scratch_ = nullptr;
  const std::int64_t block_depth_, block_rows_, n_block_, n_panel_;
  std::int64_t row_ = 0, n_row_ = 0, k_ = 0, depth_ = 0;  // rows and depth of the current block
  // How many rows of this panel, or of the previous one, have complete sums, and how many of these are finished.
  Finish finish_;
  std::int64_t n_summed_ = 0, n_finished_ = 0;
  std::int64_t n_finish_ = 0;  // rows that each call of Between finishes
};

}  // namespace vla::kernels
