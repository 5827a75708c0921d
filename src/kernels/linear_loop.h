// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/gelu_erf.h"
#include "kernels/linear_kernel.h"
#include "kernels/linear_panels.h"

/// The loops around a tile: items, cache blocking, edges, epilogue.
///
/// A tile multiplies a few rows of x by the columns of a panel (linear_panels.h) over some depth of d_in. A block of
/// rows of x is copied to rows of a fixed stride in the second cache, so that neither their addresses nor their width
/// matter to the inner loop; then one panel after the other passes by, a step of the depth at a time, which stays in
/// the first cache while all rows of the block are multiplied by it. Source of the method: Goto and van de Geijn,
/// Anatomy of High-Performance Matrix Multiplication (2008).
namespace vla::kernels {

/// A part of a panel that will be multiplied next.
struct Ahead {
  const std::byte* from;
  std::int64_t size;
};

/// `Tile` has: V (a type of vec.h), X (what x becomes), kRows and kColumns (of the product), kBlockRows (of the block
/// of x), kMaxDepth and kXStride (how deep its rows may be, and from one to the next), kManyDepth (the same where there
/// is more than one block), kStep (of the depth, most), kSplitRows (x of no more rows is split into two bf16, the
/// number rounded and what that leaves), kRounds (x becomes bf16), kEven (tiles of equal height), Session (held while a
/// thread works), and
///   copy(from, n, to, rest)           n numbers of x, zeros up to a multiple of 32; what rounding leaves, or null
///   store_rounded(to, vector, left)   y as bf16, where kRounds
///   multiply(type, n_row, x, rest, panel, depth, c, add, ahead)
///     c [kColumns] x n_row <= kRows, += where `add`; prefetches ahead
template <class Tile>
class LinearLoop {
  using V = typename Tile::V;
  using X = typename Tile::X;
  using Layout = Panels<Tile::kColumns>;
  static constexpr std::int64_t kRows = Tile::kRows, kColumns = Tile::kColumns, kBlockRows = Tile::kBlockRows;
  static constexpr std::int64_t kGateColumns = 16 * kColumns;  // of a job whose depth takes more than one block
  static constexpr std::int64_t kMinItems = 16;                // for each thread, where there are so many
  static constexpr std::int64_t kRest = kBlockRows / 2 * Tile::kXStride;
  static_assert(Tile::kMaxDepth % kPanelDepth == 0 && Tile::kManyDepth % kPanelDepth == 0);
  static_assert(Tile::kStep % kPanelDepth == 0 && kBlockRows % kRows == 0 && Tile::kSplitRows <= kBlockRows / 2);

  struct Scratch {
    // Which rows of x the block holds, from which depth on, of which job in which phase: items of one block follow each
    // other, so that a worker copies it once.
    const LinearJob* job;
    std::uint64_t phase;
    std::int64_t row, depth;
    alignas(64) X x[(kBlockRows + kRows) * Tile::kXStride];  // a tile may read rows beyond the block
    alignas(64) float normed[Tile::kMaxDepth];
    alignas(64) float sums[(kBlockRows + kRows) * kColumns];
    alignas(64) float gates[(kBlockRows + kRows) * kGateColumns];
  };

 public:
  /// The row of the table that this tile makes.
  static constexpr LinearKernel kernel(const char* name, bool (*supports)(const MatrixDesc& desc, Isa isa),
                                       const LinearKernel* few = nullptr, std::int64_t max_few = 0) {
    return {name,   Layout::packed_size, Layout::pack,    supports, cut,
            run,    sizeof(Scratch),     Tile::kMaxDepth, rounds,   few,
            max_few};
  }

 private:
  static std::int64_t cut(LinearJob& job, int n_thread) {
    const LinearLoop loop(job);
    // A group whose depth takes more than one block copies x again, which several panels must amortize.
    const std::int64_t min_panels = loop.whole_depth() ? 1 : 16;
    job.n_group =
        n_thread == 1 ? 1 : min(ceil_div(kMinItems * n_thread, loop.n_block_), ceil_div(loop.n_panel_, min_panels));
    const std::int64_t room = ceil_div(loop.n_panel_, kGateColumns / kColumns);
    if (job.gated && !loop.whole_depth() && job.n_group < room) job.n_group = room;
    return loop.n_block_ * job.n_group;
  }

  static void run(const LinearJob& job, std::int64_t item, Worker& worker) {
    [[maybe_unused]] const typename Tile::Session session;
    LinearLoop loop(job);
    loop.scratch_ = reinterpret_cast<Scratch*>(worker.scratch);
    Scratch& scratch = *loop.scratch_;
    if (scratch.phase != worker.phase || scratch.job != &job)
      scratch.phase = worker.phase, scratch.job = &job, scratch.row = -1;
    loop.item(item);
  }

  static bool rounds(std::int64_t n_row, std::int64_t d_in) {
    return Tile::kRounds && n_row > Tile::kSplitRows && d_in <= Tile::kManyDepth;
  }

  explicit LinearLoop(const LinearJob& job)
      : job_(job),
        block_rows_(even_block(job.n_row, kBlockRows, kRows)),
        n_block_(ceil_div(job.n_row, block_rows_)),
        block_depth_(even_block(job.d_in, n_block_ == 1 ? Tile::kMaxDepth : Tile::kManyDepth, kPanelDepth)) {
    for (int i = first_part(); i < job.n_part; ++i) n_panel_ += ceil_div(job.part[i].d_out, kColumns);
  }

  bool whole_depth() const { return block_depth_ >= job_.d_in; }

  /// The gate is no part of its own.
  int first_part() const { return job_.gated ? 1 : 0; }

  /// Some panels by a block of rows.
  void item(std::int64_t i) {
    const std::int64_t block = i / job_.n_group, group = i % job_.n_group;
    const std::int64_t row = block * block_rows_, n_row = min(block_rows_, job_.n_row - row);
    const std::int64_t begin = n_panel_ * group / job_.n_group, end = n_panel_ * (group + 1) / job_.n_group;
    for (std::int64_t k = 0; k < job_.d_in; k += block_depth_) {
      const std::int64_t depth = min(block_depth_, job_.d_in - k);
      take_rows(row, n_row, k, depth);
      for (std::int64_t panel = begin; panel < end; ++panel) {
        int part = first_part();
        std::int64_t i_panel = panel;  // of the part
        for (; i_panel >= ceil_div(job_.part[part].d_out, kColumns); ++part)
          i_panel -= ceil_div(job_.part[part].d_out, kColumns);
        const std::int64_t column = i_panel * kColumns;
        multiply({part, column, min(kColumns, job_.part[part].d_out - column), row, n_row, k, depth,
                  scratch_->gates + (whole_depth() ? 0 : panel - begin) * (kBlockRows + kRows) * kColumns});
      }
    }
  }

  /// Rows [row, row + n_row) of x from depth k on, unless an item before left them here.
  void take_rows(std::int64_t row, std::int64_t n_row, std::int64_t k, std::int64_t depth) {
    if (row == scratch_->row && k == scratch_->depth) return;
    scratch_->row = row, scratch_->depth = k;
    for (std::int64_t r = 0; r < n_row; ++r) {
      X* to = scratch_->x + r * Tile::kXStride;
      const std::int64_t place = (row + r) * job_.x_stride;
      if (Tile::kRounds && job_.x_type == DType::bf16)
        copy_padded(reinterpret_cast<const X*>(job_.x) + place + k, depth, to);
      else
        Tile::copy(normed(reinterpret_cast<const float*>(job_.x) + place) + k, depth, to,
                   splits() ? to + kRest : nullptr);
    }
  }

  const float* normed(const float* x) {
    const LinearJob::Norm& norm = job_.norm;
    if (norm.run == nullptr) return x;
    norm.run(x, norm.weight, norm.bias, norm.eps, scratch_->normed, job_.d_in);
    return scratch_->normed;
  }

  bool splits() const { return job_.n_row <= Tile::kSplitRows; }

  /// One panel's columns of a part by the rows of the block of x.
  struct Stripe {
    int part;
    std::int64_t column, n_column, row, n_row, k, depth;
    float* gates;  // [kColumns] x n_row
  };

  /// y of the stripe (+)= the block of x times the panel. Whatever follows the product is done while a tile of sums
  /// lies in the first cache.
  void multiply(const Stripe& s) {
    const LinearJob::Part& part = job_.part[s.part];
    const bool last = s.k + s.depth == job_.d_in;
    if (job_.gated)
      sum(
          job_.part[0], s, s.gates, s.k > 0, [](auto, auto) {}, [](auto, auto) {});
    sum(
        part, s, scratch_->sums, false,
        [&](std::int64_t r, std::int64_t n_row) {
          const std::int64_t place = (s.row + r) * part.d_out + s.column;
          fetch<1>(part.y + place * y_size(), n_row, part.d_out * y_size());
          if (last && part.residual != nullptr)
            fetch<0>(reinterpret_cast<const std::byte*>(part.residual + place), n_row, part.d_out * 4);
        },
        [&](std::int64_t r, std::int64_t n_row) {
          s.n_column == kColumns ? finish<true>(s, r, n_row) : finish<false>(s, r, n_row);
        });
  }

  std::int64_t y_size() const { return number_size(job_.y_type); }

  /// Asks for the lines of a tile that will be read, or written (kWrite = 1), when the product is there.
  template <int kWrite>
  static VLA_INLINE void fetch(const std::byte* tile, std::int64_t n_row, std::int64_t stride) {
    for (std::int64_t r = 0; r < n_row; ++r)
      for (std::int64_t n = 0; n < kColumns; n += 16) __builtin_prefetch(tile + r * stride + 4 * n, kWrite);
  }

  /// sums [kColumns] x n_row (+)= the block of x times a panel. `before` and `after` are called around the last step of
  /// each tile with its first row and their number.
  template <class Before, class After>
  VLA_INLINE void sum(const LinearJob::Part& part, const Stripe& s, float* sums, bool add, const Before& before,
                      const After& after) {
    const std::int64_t depth = round_up(s.depth, kPanelDepth), step = even_block(depth, Tile::kStep, kPanelDepth);
    const std::int64_t n_tile = ceil_div(s.n_row, kRows);
    const std::byte* panel = part.weight +
                             s.column / kColumns * Layout::size(part.type, round_up(job_.d_in, kPanelDepth)) +
                             Layout::size(part.type, s.k);
    for (std::int64_t k = 0; k < depth; k += step) {
      const std::int64_t d = min(step, depth - k), size = Layout::size(part.type, d);
      const std::byte* next = panel + size;  // prefetched meanwhile
      for (std::int64_t t = 0; t < n_tile; ++t) {
        const std::int64_t r = first_row(s.n_row, t, n_tile), n_row = first_row(s.n_row, t + 1, n_tile) - r;
        if (k + d == depth) before(r, n_row);
        const X* x = scratch_->x + r * Tile::kXStride + k;
        Tile::multiply(part.type, static_cast<int>(n_row), x, splits() ? x + kRest : nullptr, panel, d,
                       sums + r * kColumns, add || k > 0, {next + size * t / n_tile, size / n_tile});
        if (k + d == depth) after(r, n_row);
      }
      panel = next;
    }
  }

  /// Where tile t begins: tiles are of nearly equal height, or whole but for the last.
  static VLA_INLINE std::int64_t first_row(std::int64_t n_row, std::int64_t t, std::int64_t n_tile) {
    return Tile::kEven ? n_row * t / n_tile : min(t * kRows, n_row);
  }

  /// What becomes of a tile's sums, rows r to r + n_row of the stripe: behind the last block of the depth everything
  /// that follows the product, before it partial sums in y. kWhole: the stripe is kColumns wide.
  template <bool kWhole>
  void finish(const Stripe& s, std::int64_t r, std::int64_t n_row) const {
    if (s.k + s.depth < job_.d_in) return write<kWhole, false, Activation::none>(s, {}, r, n_row);
    const LinearJob::Part &part = job_.part[s.part], &gate = job_.part[0];
    const After after = {part.bias != nullptr ? part.bias + s.column : nullptr,
                         part.factor != nullptr ? part.factor + s.column : nullptr, part.residual,
                         job_.gated ? s.gates : nullptr,
                         job_.gated && gate.bias != nullptr ? gate.bias + s.column : nullptr};
    if constexpr (Tile::kRounds)
      if (job_.y_type == DType::bf16) return write_activated<kWhole, true>(s, after, r, n_row);
    write_activated<kWhole, false>(s, after, r, n_row);
  }

  /// What follows a product beside its activation; null where nothing does.
  struct After {
    const float *bias = nullptr, *factor = nullptr, *residual = nullptr, *gates = nullptr, *gate_bias = nullptr;
  };

  template <bool kWhole, bool kRounded>
  void write_activated(const Stripe& s, const After& after, std::int64_t r, std::int64_t n_row) const {
    switch (job_.activation) {
      case Activation::none:
        return write<kWhole, kRounded, Activation::none>(s, after, r, n_row);
      case Activation::gelu_tanh:
        return write<kWhole, kRounded, Activation::gelu_tanh>(s, after, r, n_row);
      case Activation::gelu_erf:
        return write<kWhole, kRounded, Activation::gelu_erf>(s, after, r, n_row);
      case Activation::silu:
        return write<kWhole, kRounded, Activation::silu>(s, after, r, n_row);
      case Activation::relu:
        return write<kWhole, kRounded, Activation::relu>(s, after, r, n_row);
    }
  }

  template <bool kRounded, Activation kActivation>
  static VLA_INLINE typename V::Float activate(typename V::Float x) {
    if constexpr (kActivation == Activation::gelu_tanh && kRounded) return gelu_tanh_for_bf16<V>(x);
    if constexpr (kActivation == Activation::gelu_erf && kRounded) return gelu_erf_for_bf16<V>(x);
    if constexpr (kActivation == Activation::silu && kRounded) return silu_for_bf16<V>(x);
    if constexpr (kActivation == Activation::gelu_tanh) return gelu_tanh<V>(x);
    if constexpr (kActivation == Activation::gelu_erf) return gelu_erf<V>(x);
    if constexpr (kActivation == Activation::silu) return silu<V>(x);
    if constexpr (kActivation == Activation::relu) return relu<V>(x);
    return x;
  }

  template <bool kWhole, bool kRounded, Activation kActivation>
  void write(const Stripe& s, const After& after, std::int64_t first, std::int64_t n_row) const {
    const LinearJob::Part& part = job_.part[s.part];
    for (std::int64_t r = first; r < first + n_row; ++r) {
      const std::int64_t row = (s.row + r) * part.d_out + s.column;
      for (std::int64_t i = 0; i < (kWhole ? kColumns : s.n_column); i += V::width) {
        const std::int64_t left = kWhole ? V::width : s.n_column - i;
        float* y = reinterpret_cast<float*>(part.y) + row + i;
        typename V::Float value = V::load(scratch_->sums + r * kColumns + i);
        if (s.k > 0) value += load<V>(y, left);
        if (after.bias != nullptr) value += load<V>(after.bias + i, left);
        if (after.gates != nullptr) {
          typename V::Float gate = V::load(after.gates + r * kColumns + i);
          if (after.gate_bias != nullptr) gate += load<V>(after.gate_bias + i, left);
          value *= activate<kRounded, kActivation>(gate);
        } else {
          value = activate<kRounded, kActivation>(value);
        }
        if (after.factor != nullptr) value *= load<V>(after.factor + i, left);
        if (after.residual != nullptr) value += load<V>(after.residual + row + i, left);
        if constexpr (kRounded)
          Tile::store_rounded(reinterpret_cast<X*>(part.y) + row + i, value, left);
        else
          store<V>(y, value, left);
      }
    }
  }

  const LinearJob& job_;
  Scratch* scratch_ = nullptr;
  const std::int64_t block_rows_, n_block_, block_depth_;
  std::int64_t n_panel_ = 0;
};

}  // namespace vla::kernels
