// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "backend/matrix.h"
#include "kernels/linear_job.h"
#include "kernels/math.h"

/// The loops around a tile: which thread does what, what lies in which cache, edges, and the epilogue.
///
/// A tile multiplies a few rows of x by a few columns of the product (rows of W) over some depth of d_in. Columns are
/// read from a *panel*, in which the tile's columns lie together for each step of the depth. Panels are made from the
/// stored rows on the way (a transposition in registers, once for all rows of x) and live in the second cache; a block
/// of x is copied to rows of a fixed stride, so that neither its addresses nor its width matter to the inner loop.
/// Source of the method: Goto and van de Geijn, Anatomy of High-Performance Matrix Multiplication (2008).
namespace vla::kernels {

constexpr VLA_INLINE std::int64_t least(std::int64_t a, std::int64_t b) { return a < b ? a : b; }
constexpr VLA_INLINE std::int64_t pieces(std::int64_t n, std::int64_t size) { return (n + size - 1) / size; }
constexpr VLA_INLINE std::int64_t round_up(std::int64_t n, std::int64_t unit) { return pieces(n, unit) * unit; }
/// n cut into as few equal pieces as `most` allows, each a multiple of `unit`.
constexpr VLA_INLINE std::int64_t even_piece(std::int64_t n, std::int64_t most, std::int64_t unit) {
  return n == 0 ? unit : round_up(pieces(n, pieces(n, most)), unit);
}

/// `Tile` has: V (a type of vec.h), X (what x becomes), kRows and kColumns (of the product), kDepth (a panel's depth is
/// a multiple of it), kMaxDepth, kBlockRows and kBlockColumns (of what stays in caches), kXStride (of the block of x),
/// kPackCost (of making a panel, in rows that it is multiplied by), kCopyCost (of a row of x, in panels), kPacked
/// (panels are made at load), kEven (tiles of equal height), Session (held while a thread works), and
///   panel_size(type, depth)                         bytes of a panel
///   pack(type, rows, d_in, n_column, depth, panel)  a panel from n_column <= kColumns stored rows, zeros around it
///   copy(from, n, to)                               n numbers of x and zeros up to a multiple of kDepth
///   multiply(type, n_row, x, panel, depth, c, stride, add)   c [kColumns] x n_row <= kRows, += where `add`
template <class Tile>
class LinearLoop {
  using V = typename Tile::V;
  using X = typename Tile::X;
  static constexpr std::int64_t kRows = Tile::kRows, kColumns = Tile::kColumns, kDepth = Tile::kDepth;
  static constexpr std::int64_t kGateRows = round_up(256, kRows), kGateColumns = Tile::kBlockColumns / 2;
  static_assert(Tile::kMaxDepth % kDepth == 0 && Tile::kBlockRows % kRows == 0 && kGateColumns % kColumns == 0);

  struct Scratch {
    alignas(64) X x[(Tile::kBlockRows + kRows) * Tile::kXStride];  // a tile may read rows beyond the block
    alignas(64) std::byte panels[Tile::kPacked ? 64 : 2 * kGateColumns * Tile::kMaxDepth * sizeof(float)];
    alignas(64) float gate[kGateRows * kGateColumns];
    alignas(64) float edge[kRows * kColumns];
  };

 public:
  static constexpr std::size_t kScratchSize = sizeof(Scratch);

  static void run(const LinearJob& job, int ith, int nth, std::byte* scratch) {
    LinearLoop loop(job, *reinterpret_cast<Scratch*>(scratch));
    const Share share(job, ith, nth);
    if (share.row_begin == share.row_end || share.panel_begin == share.panel_end) return;
    [[maybe_unused]] const typename Tile::Session session;
    std::int64_t first = 0;  // panel of the part
    for (int i = job.gated ? 1 : 0; i < job.n_part; ++i) {
      const std::int64_t n = pieces(job.part[i].d_out, kColumns);
      const std::int64_t begin = share.panel_begin - first, end = least(share.panel_end - first, n);
      if (end > 0 && begin < n) loop.columns(i, (begin > 0 ? begin : 0) * kColumns, end * kColumns, share);
      first += n;
    }
  }

  static std::size_t packed_size(const MatrixDesc& desc) {
    return static_cast<std::size_t>(pieces(desc.d_out, kColumns)) * Tile::panel_size(desc.type, padded(desc.d_in));
  }

  static void pack(const MatrixDesc& desc, const std::byte* stored, std::byte* packed) {
    for (std::int64_t n = 0; n < desc.d_out; n += kColumns) {
      const auto offset = static_cast<std::size_t>(n * desc.d_in) * (desc.type == DType::f32 ? 4 : 2);
      Tile::pack(desc.type, stored + offset, desc.d_in, least(desc.d_out - n, kColumns), desc.d_in, packed);
      packed += Tile::panel_size(desc.type, padded(desc.d_in));
    }
  }

 private:
  static std::int64_t padded(std::int64_t depth) { return round_up(depth, kDepth); }

  /// What one thread computes: some rows of x by some panels of all parts, counted one after the other.
  struct Share {
    std::int64_t row_begin, row_end, panel_begin, panel_end;

    Share(const LinearJob& job, std::int64_t ith, std::int64_t nth) {
      std::int64_t n_panel = 0;
      for (int i = job.gated ? 1 : 0; i < job.n_part; ++i) n_panel += pieces(job.part[i].d_out, kColumns);
      const std::int64_t n_tile = pieces(job.n_row, kRows);
      // Threads work in a grid, such that the slowest is done first. Every thread makes the panels of its columns and
      // the copies of its rows.
      std::int64_t n_side = nth, best = 0;
      for (std::int64_t side = nth; side >= 1; --side) {
        if (nth % side != 0) continue;
        const std::int64_t n_row = least(pieces(n_tile, nth / side) * kRows, job.n_row), n = pieces(n_panel, side);
        const std::int64_t cost = n * (n_row + Tile::kPackCost) + n_row * Tile::kCopyCost;
        if (best == 0 || cost < best) best = cost, n_side = side;
      }
      const std::int64_t n_deep = nth / n_side, column = ith % n_side, row = ith / n_side;
      panel_begin = n_panel * column / n_side, panel_end = n_panel * (column + 1) / n_side;
      row_begin = least(n_tile * row / n_deep * kRows, job.n_row);
      row_end = least(n_tile * (row + 1) / n_deep * kRows, job.n_row);
    }
  };

  LinearLoop(const LinearJob& job, Scratch& scratch)
      : job_(job), scratch_(scratch), step_(even_piece(job.d_in, Tile::kMaxDepth, kDepth)) {}

  /// Columns [begin, end) of part i for the share's rows.
  void columns(int i, std::int64_t begin, std::int64_t end, const Share& share) {
    end = least(end, job_.part[i].d_out);
    const std::int64_t n_row = job_.gated ? even_piece(share.row_end - share.row_begin, kGateRows, kRows) : job_.n_row;
    const std::int64_t width = even_piece(end - begin, job_.gated ? kGateColumns : most_columns(i), kColumns);
    for (std::int64_t row = share.row_begin; row < share.row_end; row += n_row)
      for (std::int64_t column = begin; column < end; column += width)
        block(i, column, least(column + width, end), row, least(row + n_row, share.row_end));
  }

  /// Columns [begin, end) of part i, few enough for their panels to be kept, by rows [row_begin, row_end).
  void block(int i, std::int64_t begin, std::int64_t end, std::int64_t row_begin, std::int64_t row_end) {
    const std::int64_t n_row = even_piece(row_end - row_begin, Tile::kBlockRows, kRows);
    for (std::int64_t k = 0; k < job_.d_in; k += step_) {
      const std::int64_t depth = least(step_, job_.d_in - k);
      const std::byte* gate = job_.gated ? panels(0, begin, end, k, depth, 1) : nullptr;
      const std::byte* panel = panels(i, begin, end, k, depth, 0);
      for (std::int64_t row = row_begin; row < row_end; row += n_row) {
        const std::int64_t rows = least(n_row, row_end - row);
        for (std::int64_t r = 0; r < rows; ++r)
          Tile::copy(job_.x + (row + r) * job_.d_in + k, depth, scratch_.x + r * Tile::kXStride);
        float* gates = scratch_.gate + (row - row_begin) * kGateColumns;
        for (std::int64_t n = begin; n < end; n += kColumns) {
          const std::int64_t i_panel = (n - begin) / kColumns;
          const Stripe stripe = {i, n, least(kColumns, end - n), row, rows, k, depth, gates + (n - begin)};
          if (job_.gated) multiply_gate(stripe, gate + i_panel * panel_stride(0, depth));
          multiply(stripe, panel + i_panel * panel_stride(i, depth));
        }
      }
    }
  }

  /// One panel's columns of part i by the rows of the block of x.
  struct Stripe {
    int i;
    std::int64_t column, n_column, row, n_row, k, depth;
    float* gates;  // [kGateColumns] x n_row
  };

  /// How many columns' panels there is room for: more than kBlockColumns where those are smaller than panels of floats.
  std::int64_t most_columns(int i) const {
    if (Tile::kPacked) return Tile::kBlockColumns;
    return static_cast<std::int64_t>(sizeof(scratch_.panels)) / panel_stride(i, step_) * kColumns;
  }

  /// Bytes from one panel of part i to the next.
  std::int64_t panel_stride(int i, std::int64_t depth) const {
    return static_cast<std::int64_t>(Tile::panel_size(job_.part[i].type, padded(Tile::kPacked ? job_.d_in : depth)));
  }

  /// The panels of columns [begin, end) of part i from depth k on; those of up and gate stand in two halves.
  const std::byte* panels(int i, std::int64_t begin, std::int64_t end, std::int64_t k, std::int64_t depth, int half) {
    const std::byte* weight = job_.part[i].weight;
    if (Tile::kPacked)
      return weight + begin / kColumns * panel_stride(i, depth) + Tile::panel_size(job_.part[i].type, k);
    std::byte* first =
        scratch_.panels + static_cast<std::size_t>(half * kGateColumns * Tile::kMaxDepth) * sizeof(float);
    const std::int64_t size = job_.part[i].type == DType::f32 ? 4 : 2;
    for (std::int64_t n = begin; n < end; n += kColumns)
      Tile::pack(job_.part[i].type, weight + (n * job_.d_in + k) * size, job_.d_in, least(end - n, kColumns), depth,
                 first + (n - begin) / kColumns * panel_stride(i, depth));
    return first;
  }

  void multiply_gate(const Stripe& s, const std::byte* panel) {
    tiles(s.n_row, [&](std::int64_t r, std::int64_t n_row) {
      multiply_tile(0, s, r, n_row, panel, s.gates + r * kGateColumns, kGateColumns);
    });
  }

  /// y of the stripe (+)= the block of x times the panel. Whatever follows the product is done while a tile of y lies
  /// in the first cache.
  void multiply(const Stripe& s, const std::byte* panel) {
    const LinearJob::Part& part = job_.part[s.i];
    const bool last = s.k + s.depth == job_.d_in;
    tiles(s.n_row, [&](std::int64_t r, std::int64_t n_row) {
      const std::int64_t place = (s.row + r) * part.d_out + s.column;
      fetch(part.y + place, n_row, part.d_out);
      if (last && part.residual != nullptr) fetch(part.residual + place, n_row, part.d_out);
      multiply_tile(s.i, s, r, n_row, panel, part.y + place, part.d_out);
      if (last) finish(s, r, n_row);
    });
  }

  /// Asks for the lines of a tile that will be read or written when the product over the panel's depth is there.
  static VLA_INLINE void fetch(const float* tile, std::int64_t n_row, std::int64_t stride) {
    for (std::int64_t r = 0; r < n_row; ++r)
      for (std::int64_t n = 0; n < kColumns; n += 16) __builtin_prefetch(tile + r * stride + n);
  }

  template <class Do>
  static VLA_INLINE void tiles(std::int64_t n_row, const Do& tile) {
    const std::int64_t n_tile = pieces(n_row, kRows);
    for (std::int64_t t = 0; t < n_tile; ++t) {
      const std::int64_t r = first_row(n_row, t, n_tile);
      tile(r, first_row(n_row, t + 1, n_tile) - r);
    }
  }

  /// c [stride] x n_row (+)= rows r to r + n_row of the block of x times a panel of part i.
  VLA_INLINE void multiply_tile(int i, const Stripe& s, std::int64_t r, std::int64_t n_row, const std::byte* panel,
                                float* c, std::int64_t stride) {
    const X* x = scratch_.x + r * Tile::kXStride;
    const std::int64_t depth = padded(s.depth);
    if (s.n_column == kColumns)
      Tile::multiply(job_.part[i].type, static_cast<int>(n_row), x, panel, depth, c, stride, s.k > 0);
    else
      multiply_edge(job_.part[i].type, s.n_column, n_row, x, panel, depth, c, stride, s.k > 0);
  }

  /// Where tile t begins: tiles are of nearly equal height, or whole but for the last.
  static VLA_INLINE std::int64_t first_row(std::int64_t n_row, std::int64_t t, std::int64_t n_tile) {
    return Tile::kEven ? n_row * t / n_tile : least(t * kRows, n_row);
  }

  /// The last columns, fewer than a tile has.
  void multiply_edge(DType type, std::int64_t n_column, std::int64_t n_row, const X* x, const std::byte* panel,
                     std::int64_t depth, float* c, std::int64_t stride, bool add) {
    Tile::multiply(type, static_cast<int>(n_row), x, panel, depth, scratch_.edge, kColumns, false);
    for (std::int64_t r = 0; r < n_row; ++r)
      for (std::int64_t n = 0; n < n_column; ++n) {
        const float value = scratch_.edge[r * kColumns + n];
        c[r * stride + n] = add ? c[r * stride + n] + value : value;
      }
  }

  /// The epilogue of a tile: rows r to r + n_row of the stripe.
  void finish(const Stripe& s, std::int64_t r, std::int64_t n_row) {
    const LinearJob::Part& part = job_.part[s.i];
    if (job_.gated) return finish_gated(s, r, n_row);
    switch (job_.activation) {
      case Activation::none:
        if (part.bias != nullptr || part.residual != nullptr) finish_rows<Activation::none>(s, r, n_row);
        return;
      case Activation::gelu_tanh:
        return finish_rows<Activation::gelu_tanh>(s, r, n_row);
      case Activation::silu:
        return finish_rows<Activation::silu>(s, r, n_row);
    }
  }

  template <Activation kActivation>
  static VLA_INLINE typename V::Float activate(typename V::Float x) {
    if constexpr (kActivation == Activation::gelu_tanh) return gelu_tanh<V>(x);
    if constexpr (kActivation == Activation::silu) return silu<V>(x);
    return x;
  }

  template <Activation kActivation>
  void finish_rows(const Stripe& s, std::int64_t first, std::int64_t n_row) const {
    const LinearJob::Part& part = job_.part[s.i];
    for (std::int64_t r = first; r < first + n_row; ++r)
      for (std::int64_t i = 0; i < s.n_column; i += V::width) {
        const std::int64_t place = (s.row + r) * part.d_out + s.column + i, left = s.n_column - i;
        typename V::Float value = load<V>(part.y + place, left);
        if (part.bias != nullptr) value += load<V>(part.bias + s.column + i, left);
        value = activate<kActivation>(value);
        if (part.residual != nullptr) value += load<V>(part.residual + place, left);
        store<V>(part.y + place, value, left);
      }
  }

  void finish_gated(const Stripe& s, std::int64_t first, std::int64_t n_row) const {
    const LinearJob::Part &part = job_.part[s.i], &gate = job_.part[0];
    for (std::int64_t r = first; r < first + n_row; ++r)
      for (std::int64_t i = 0; i < s.n_column; i += V::width) {
        const std::int64_t place = (s.row + r) * part.d_out + s.column + i, left = s.n_column - i;
        typename V::Float value = load<V>(part.y + place, left), factor = load<V>(s.gates + r * kGateColumns + i, left);
        if (part.bias != nullptr) value += load<V>(part.bias + s.column + i, left);
        if (gate.bias != nullptr) factor += load<V>(gate.bias + s.column + i, left);
        if (job_.activation == Activation::gelu_tanh) factor = gelu_tanh<V>(factor);
        if (job_.activation == Activation::silu) factor = silu<V>(factor);
        value *= factor;
        if (part.residual != nullptr) value += load<V>(part.residual + place, left);
        store<V>(part.y + place, value, left);
      }
  }

  const LinearJob& job_;
  Scratch& scratch_;
  const std::int64_t step_;  // of the depth
};

}  // namespace vla::kernels
