// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/attention_kernel.h"
#include "kernels/math.h"

/// The arithmetics that attention computes in: float32, pairs of bf16 by vector instructions, pairs of bf16 by tiles.
/// Both products of attention have the same form: rows of elements times panels, which hold every column's element for
/// each step of the depth.
namespace vla::kernels {

/// From one row of a block to the next, where a row may have n elements: a little apart from powers of two, so that
/// rows do not compete for the same lines of the cache.
constexpr int row_stride(int n) { return n + 32; }
constexpr int kHeadStride = row_stride(kMaxHead);

/// Float32: kRowsOfTile rows times two vectors, one operand broadcast. `V` is a type of vec.h.
template <class V, int kRowsOfTile, int kVectorsOfPanel = 2>
struct FloatProducts {
  using Vector = V;
  using Float = typename V::Float;
  using Number = float;
  struct Session {};
  static constexpr int kTile = kRowsOfTile, kRows = 24, kPart = kRows;  // rows of a tile, of a block, of a pass
  static constexpr int kKeys = 128;                                     // of a chunk
  static constexpr int kVectors = kVectorsOfPanel, kPanel = kVectors * V::width;
  static constexpr int kMinPanel = V::width, kDepth = 1;  // columns; unit of the depth
  static constexpr bool kBeside = false;
  static constexpr RoundedLayout kRounded = RoundedLayout::none;

  /// Weights are e^x, and relative to the greatest score of their row.
  static constexpr float kLogOfE = 1, kSlack = 0;
  static VLA_INLINE Float power(Float x) { return exp_of_negative<V>(x); }

  /// Two vectors as elements.
  static VLA_INLINE void store(Number* to, Float a, Float b) {
    V::store(to, a);
    V::store(to + V::width, b);
  }

  /// Rows become the columns of a panel.
  static VLA_INLINE void put_keys(const Number* rows, std::int64_t depth, Number* panel) {
    for (std::int64_t k = 0; k < depth; k += V::width)
      for (int n = 0; n < kPanel; n += V::width) {
        Float x[V::width];
        for (int i = 0; i < V::width; ++i) x[i] = V::load(rows + (n + i) * kHeadStride + k);
        transpose<V>(x);
        const int n_line = static_cast<int>(depth - k < V::width ? depth - k : V::width);
        for (int i = 0; i < n_line; ++i) V::store(panel + (k + i) * kPanel + n, x[i]);
      }
  }

  /// kPanel rows become as many steps of the depth, from `k` on, of a panel of `width` columns.
  static VLA_INLINE void put_values(const Number* rows, std::int64_t k, std::int64_t width, Number* panel) {
    for (int i = 0; i < kPanel; ++i) {
      const Number* row = rows + i * kHeadStride;
      Number* line = panel + (k + i) * width;
      V::store(line, V::load(row));
      if (width == kPanel) V::store(line + V::width, V::load(row + V::width));
    }
  }

  /// Products, each done at once.
  struct Work {
    /// c = a * panel, or c += where `sum`. a [depth, kTile] and c [width, kTile], rows `kStrideA` and `kStrideC` apart.
    template <int kStrideA, int kStrideC>
    VLA_INLINE void add(const float* a, const float* panel, std::int64_t depth, std::int64_t width, float* c,
                        bool sum) {
      if (width == kPanel)
        multiply<2, kStrideA, kStrideC>(a, panel, depth, c, sum);
      else
        multiply<1, kStrideA, kStrideC>(a, panel, depth, c, sum);
    }
    int n_step() const { return 0; }
    void advance(int) const {}
    void finish() const {}
  };

 private:
  template <int kVectors, int kStrideA, int kStrideC>
  static VLA_INLINE void multiply(const float* a, const float* panel, std::int64_t depth, float* c, bool sum) {
    Float sums[kTile][kVectors] = {};
#pragma GCC unroll 4
    for (std::int64_t i = 0; i < depth; ++i) {
      Float column[kVectors];
      for (int n = 0; n < kVectors; ++n) column[n] = V::load(panel + (i * kVectors + n) * V::width);
#pragma GCC unroll 16
      for (int r = 0; r < kTile; ++r) {
        const Float row = V::set(a[r * kStrideA + i]);
        for (int n = 0; n < kVectors; ++n) sums[r][n] = V::fma(row, column[n], sums[r][n]);
      }
    }
    for (int r = 0; r < kTile; ++r)
      for (int n = 0; n < kVectors; ++n) {
        float* out = c + r * kStrideC + n * V::width;
        V::store(out, sum ? V::load(out) + sums[r][n] : sums[r][n]);
      }
  }
};

/// Elements rounded to bf16, sums in float32, and how panels hold them. `Pairs` rounds two vectors: store(to, a, b).
template <class V, class Pairs>
struct PairPanels {
  using Vector = V;
  using Float = typename V::Float;
  using Number = std::uint16_t;
  static constexpr int kPanel = 32, kMinPanel = 32, kDepth = 32;

  /// Weights are 2^x. Rounding errs by a share of a weight, so that weights may as well be up to 2^kSlack: then the
  /// greatest score of a row seldom moves far enough to scale down what was mixed before.
  static constexpr float kLogOfE = 1.44269504f, kSlack = 8;
  static VLA_INLINE Float power(Float x) { return exp2_for_bf16<V>(x); }

  /// The place of element `k` of column `n` in a panel: for each 32 of the depth two tiles of 16 columns; in each of
  /// their 16 lines a pair of every column.
  static constexpr std::int64_t place(std::int64_t k, std::int64_t n) {
    return k / 32 * 1024 + n / 16 * 512 + k % 32 / 2 * 32 + n % 16 * 2 + k % 2;
  }

  static VLA_INLINE void store(Number* to, Float a, Float b) { Pairs::store(to, a, b); }

  /// A pair of consecutive elements stays a word, so that a tile is the transpose of 16 rows of words.
  static VLA_INLINE void put_keys(const Number* rows, std::int64_t depth, Number* panel) {
    for (std::int64_t k = 0; k < depth; k += 2 * V::width)
      for (int n = 0; n < kPanel; n += V::width) {
        Float words[V::width];
        for (int i = 0; i < V::width; ++i) words[i] = load_words(rows + (n + i) * kHeadStride + k);
        transpose<V>(words);
        Number* lines = panel + place(k, n);
        for (int i = 0; i < V::width; ++i) store_words(lines + i * 32, words[i]);
      }
  }

  /// The pairs are elements of consecutive rows here.
  static VLA_INLINE void put_values(const Number* rows, std::int64_t k, std::int64_t, Number* panel) {
    panel += place(k, 0);
    for (int i = 0; i < kPanel; i += 2)
      for (int n = 0; n < kPanel; n += 2 * V::width) {
        using Int = typename V::Int;
        const auto a = std::bit_cast<Int>(load_words(rows + i * kHeadStride + n));
        const auto b = std::bit_cast<Int>(load_words(rows + (i + 1) * kHeadStride + n));
        const auto even = std::bit_cast<Float>((a & 0xffff) | b << 16);
        const auto odd = std::bit_cast<Float>((a >> 16 & 0xffff) | (b & ~0xffff));
        store_words(panel + place(i, n), V::interleave_low(even, odd));
        store_words(panel + place(i, n + V::width), V::interleave_high(even, odd));
      }
  }

 protected:
  static VLA_INLINE Float load_words(const Number* p) {
    Float x;
    std::memcpy(&x, p, sizeof(x));
    return x;
  }
  static VLA_INLINE void store_words(Number* p, Float x) { std::memcpy(p, &x, sizeof(x)); }
};

/// A vector instruction adds the products of both elements of a pair: `Pairs` has add(sum, pairs, pairs). Rows of a
/// tile times 32 columns, a pair of the row broadcast.
template <class V, int kRowsOfTile, class Pairs>
struct VectorPairProducts : PairPanels<V, Pairs> {
  using Base = PairPanels<V, Pairs>;
  using typename Base::Float;
  using typename Base::Number;
  struct Session {};
  static constexpr int kTile = kRowsOfTile, kRows = 2 * kTile, kPart = kRows, kKeys = 256;
  static constexpr bool kBeside = false;
  static constexpr RoundedLayout kRounded = RoundedLayout::rows;

  /// Products, each done at once.
  struct Work {
    /// c = a * panel, or c += where `sum`.
    template <int kStrideA, int kStrideC>
    VLA_INLINE void add(const Number* a, const Number* panel, std::int64_t depth, std::int64_t, float* c, bool sum) {
      constexpr int kVectors = Base::kPanel / V::width;
      Float sums[kTile][kVectors] = {};
      for (std::int64_t k = 0; k < depth; k += 2) {
        Float columns[kVectors];
        for (int n = 0; n < kVectors; ++n) columns[n] = Base::load_words(panel + Base::place(k, n * V::width));
#pragma GCC unroll 16
        for (int r = 0; r < kTile; ++r) {
          float pair;
          std::memcpy(&pair, a + r * kStrideA + k, sizeof(pair));
          const Float row = V::set(pair);
          for (int n = 0; n < kVectors; ++n) sums[r][n] = Pairs::add(sums[r][n], columns[n], row);
        }
      }
      for (int r = 0; r < kTile; ++r)
        for (int n = 0; n < kVectors; ++n) {
          float* out = c + r * kStrideC + n * V::width;
          V::store(out, sum ? V::load(out) + sums[r][n] : sums[r][n]);
        }
    }
    int n_step() const { return 0; }
    void advance(int) const {}
    void finish() const {}
  };
};

/// 32 rows times 32 columns through a tile type (AMX, or its emulation) that holds the sums between `open` and `close`,
/// adds 32 of the depth in each `step`, and rounds. Strides are elements from one row to the next.
template <class V, class Tile>
struct PairProducts : PairPanels<V, Tile> {
  using Base = PairPanels<V, Tile>;
  using typename Base::Number;
  using Session = typename Tile::Session;
  using Base::kDepth, Base::kPanel;
  static constexpr int kTile = 32, kRows = 64, kPart = 32, kKeys = 256;
  static constexpr bool kBeside = true;  // products wait for other work to be done beside it
  static constexpr RoundedLayout kRounded = RoundedLayout::tiles;

  /// Products that are done a step at a time between other work: while the vector instructions before and behind a
  /// step wait for each other, the unit of the tiles, which is one of its own, computes. The processor looks some 500
  /// instructions ahead, so that steps are short.
  class Work {
   public:
    /// c = a * panel, or c += where `sum`.
    template <int kStrideA, int kStrideC>
    VLA_INLINE void add(const Number* a, const Number* panel, std::int64_t depth, std::int64_t, float* c, bool sum) {
      waiting_[n_waiting_++] = {.a = a,
                                .panel = panel,
                                .c = c,
                                .stride_a = kStrideA,
                                .stride_c = kStrideC,
                                .n_step = static_cast<int>(depth / kDepth),
                                .sum = sum};
      n_step_ += static_cast<int>(depth / kDepth);
    }
    /// Steps of everything that was added since the last `finish`.
    int n_step() const { return n_step_; }
    /// Does the next n steps, or what there is.
    VLA_INLINE void advance(int n) {
      for (; n > 0 && first_ < n_waiting_; --n) {
        const Product& product = waiting_[first_];
        if (step_ == 0) tile_.open(product.c, product.stride_c, product.sum);
        tile_.step(product.a + step_ * kDepth, product.stride_a, product.panel + step_ * kDepth * kPanel);
        if (++step_ < product.n_step) continue;
        tile_.close(product.c, product.stride_c);
        step_ = 0, ++first_;
      }
    }
    VLA_INLINE void finish() {
      advance(n_step_);
      first_ = n_waiting_ = n_step_ = 0;
    }

   private:
    struct Product {
      const Number *a, *panel;
      float* c;
      int stride_a, stride_c, n_step;
      bool sum;
    };
    Product waiting_[kKeys / kPanel + kMaxHead / kPanel];
    int n_waiting_ = 0, n_step_ = 0, first_ = 0, step_ = 0;  // step_: of the first that waits
    Tile tile_;
  };
};

}  // namespace vla::kernels
