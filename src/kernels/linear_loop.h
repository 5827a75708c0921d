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
    const std::int64_t width = job_.gated ? kGateColumns : 2 * kGateColumns;
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
        if (job_.gated) multiply(0, begin, end, rows, gate, k, gates, kGateColumns);
        multiply(i, begin, end, rows, panel, k, job_.part[i].y + row * job_.part[i].d_out + begin, job_.part[i].d_out);
        if (k + depth == job_.d_in)
          for (std::int64_t r = 0; r < rows; ++r) finish(i, begin, end, row + r, gates + r * kGateColumns);
      }
    }
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

  /// c [stride] x rows (+)= the block of x times the panels; c starts at column `begin`.
  void multiply(int i, std::int64_t begin, std::int64_t end, std::int64_t rows, const std::byte* panel, std::int64_t k,
                float* c, std::int64_t stride) {
    const std::int64_t depth = padded(least(step_, job_.d_in - k)), n_tile = pieces(rows, kRows);
    const std::int64_t limit = least(end, job_.part[i].d_out);
    for (std::int64_t n = begin; n < end; n += kColumns, c += kColumns, panel += panel_stride(i, depth))
      for (std::int64_t t = 0; t < n_tile; ++t) {
        const std::int64_t r = first_row(rows, t, n_tile), n_row = first_row(rows, t + 1, n_tile) - r;
        const X* x = scratch_.x + r * Tile::kXStride;
        if (limit - n >= kColumns)
          Tile::multiply(job_.part[i].type, static_cast<int>(n_row), x, panel, depth, c + r * stride, stride, k > 0);
        else
          multiply_edge(job_.part[i].type, limit - n, n_row, x, panel, depth, c + r * stride, stride, k > 0);
      }
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

  /// The epilogue of columns [begin, end) of one row.
  void finish(int i, std::int64_t begin, std::int64_t end, std::int64_t row, const float* gate) {
    const LinearJob::Part& part = job_.part[i];
    const std::int64_t offset = row * part.d_out + begin, n = end - begin;
    const float* bias = part.bias == nullptr ? nullptr : part.bias + begin;
    const float* residual = part.residual == nullptr ? nullptr : part.residual + offset;
    if (job_.gated) {
      const float* gate_bias = job_.part[0].bias == nullptr ? nullptr : job_.part[0].bias + begin;
      return finish_gated(part.y + offset, bias, gate, gate_bias, residual, n);
    }
    switch (job_.activation) {
      case Activation::none:
        if (bias != nullptr || residual != nullptr) finish_row<Activation::none>(part.y + offset, bias, residual, n);
        return;
      case Activation::gelu_tanh:
        return finish_row<Activation::gelu_tanh>(part.y + offset, bias, residual, n);
      case Activation::silu:
        return finish_row<Activation::silu>(part.y + offset, bias, residual, n);
    }
  }

  template <Activation kActivation>
  static VLA_INLINE typename V::Float activate(typename V::Float x) {
    if constexpr (kActivation == Activation::gelu_tanh) return gelu_tanh<V>(x);
    if constexpr (kActivation == Activation::silu) return silu<V>(x);
    return x;
  }

  template <Activation kActivation>
  static void finish_row(float* y, const float* bias, const float* residual, std::int64_t n) {
    for (std::int64_t i = 0; i < n; i += V::width) {
      typename V::Float value = load<V>(y + i, n - i);
      if (bias != nullptr) value += load<V>(bias + i, n - i);
      value = activate<kActivation>(value);
      if (residual != nullptr) value += load<V>(residual + i, n - i);
      store<V>(y + i, value, n - i);
    }
  }

  void finish_gated(float* y, const float* bias, const float* gate, const float* gate_bias, const float* residual,
                    std::int64_t n) const {
    for (std::int64_t i = 0; i < n; i += V::width) {
      typename V::Float value = load<V>(y + i, n - i), factor = load<V>(gate + i, n - i);
      if (bias != nullptr) value += load<V>(bias + i, n - i);
      if (gate_bias != nullptr) factor += load<V>(gate_bias + i, n - i);
      if (job_.activation == Activation::gelu_tanh) factor = gelu_tanh<V>(factor);
      if (job_.activation == Activation::silu) factor = silu<V>(factor);
      value *= factor;
      if (residual != nullptr) value += load<V>(residual + i, n - i);
      store<V>(y + i, value, n - i);
    }
  }

  const LinearJob& job_;
  Scratch& scratch_;
  const std::int64_t step_;  // of the depth
};

}  // namespace vla::kernels
