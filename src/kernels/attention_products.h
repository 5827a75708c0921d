// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/attention_kernel.h"
#include "kernels/math.h"

/// The arithmetics of attention: float32, pairs of bf16 with vector instructions, pairs of bf16 with tiles. Both
/// products of attention multiply rows by panels, which hold every column's element for each step of the depth.
namespace vla::kernels {

/// The stride of block rows with up to n elements. It avoids powers of two, so that rows do not compete for the same
/// cache lines.
constexpr int row_stride(int n) { return n + 32; }
constexpr int kHeadStride = row_stride(kMaxHead);

/// Float32: kRowsOfTile rows by two vectors, one operand broadcast. `V` is a type of vec.h.
template <class V, int kRowsOfTile, int kVectorsOfPanel = 2>
struct FloatProducts {
  using Vector = V;
  using Float = typename V::Float;
  using Number = float;
  struct Session {};
  static constexpr int kTile = kRowsOfTile, kRows = 24, kPart = kRows;  // rows of a tile, a block, a pass
  static constexpr int kKeys = 128;                                     // keys of a chunk
  static constexpr int kVectors = kVectorsOfPanel, kPanel = kVectors * V::width;
  static constexpr int kMinPanel = V::width, kDepth = 1;  // columns of a panel; unit of the depth
  static constexpr bool kBeside = false;
  static constexpr RoundedLayout kRounded = RoundedLayout::none;

  /// Weights are e^x, relative to the largest score of their row.
  static constexpr float kLogOfE = 1, kSlack = 0;
  static VLA_INLINE Float power(Float x) { return exp_of_negative<V>(x); }

  /// Stores two vectors as elements.
  static VLA_INLINE void store(Number* to, Float a, Float b) {
    V::store(to, a);
    V::store(to + V::width, b);
  }

  /// Transposes rows into the columns of a panel.
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

  /// Copies kPanel rows as steps of the depth, starting at `k`, of a panel of `width` columns.
  static VLA_INLINE void put_values(const Number* rows, std::int64_t k, std::int64_t width, Number* panel) {
    for (int i = 0; i < kPanel; ++i) {
      const Number* row = rows + i * kHeadStride;
      Number* line = panel + (k + i) * width;
      V::store(line, V::load(row));
      if (width == kPanel) V::store(line + V::width, V::load(row + V::width));
    }
  }

  /// Products that are computed immediately.
  struct Work {
    /// c = a * panel, or c += a * panel if `sum`. a [depth, kTile] and c [width, kTile], with row strides `kStrideA`
    /// and `kStrideC`.
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

/// Elements rounded to bf16 with sums in float32, and how panels store them. `Pairs` rounds two vectors: store(to, a,
/// b).
template <class V, class Pairs>
struct PairPanels {
  using Vector = V;
  using Float = typename V::Float;
  using Number = std::uint16_t;
  static constexpr int kPanel = 32, kMinPanel = 32, kDepth = 32;

  /// Weights are 2^x. Rounding errors are relative, so weights may be as large as 2^kSlack: then a row's largest score
  /// rarely rises enough to rescale the output.
  static constexpr float kLogOfE = 1.44269504f, kSlack = 8;
  static VLA_INLINE Float power(Float x) { return exp2_for_bf16<V>(x); }

  /// The place of element `k` of column `n` in a panel: two tiles of 16 columns for each 32 of the depth; each of a
  /// tile's 16 lines has a pair of every column.
  static constexpr std::int64_t place(std::int64_t k, std::int64_t n) {
    return k / 32 * 1024 + n / 16 * 512 + k % 32 / 2 * 32 + n % 16 * 2 + k % 2;
  }

  static VLA_INLINE void store(Number* to, Float a, Float b) { Pairs::store(to, a, b); }

  /// A pair of consecutive elements is one word, so a tile is the transpose of 16 rows of words.
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

  /// A pair consists of the elements of two consecutive rows in one column.
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

/// Multiplies kRowsOfTile rows by 32 columns with a vector instruction that adds both products of a pair; a pair of the
/// row is broadcast. `Pairs` also has add(sum, pairs, pairs).
template <class V, int kRowsOfTile, class Pairs>
struct VectorPairProducts : PairPanels<V, Pairs> {
  using Base = PairPanels<V, Pairs>;
  using typename Base::Float;
  using typename Base::Number;
  struct Session {};
  static constexpr int kTile = kRowsOfTile, kRows = 2 * kTile, kPart = kRows, kKeys = 256;
  static constexpr bool kBeside = false;
  static constexpr RoundedLayout kRounded = RoundedLayout::rows;

  /// Products that are computed immediately.
  struct Work {
    /// c = a * panel, or c += a * panel if `sum`.
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

/// 32 rows by 32 columns through a tile type (AMX or its emulation) that holds the sums between `open` and `close`,
/// adds 32 of the depth in each `step`, and rounds. Strides are in elements.
template <class V, class Tile>
struct PairProducts : PairPanels<V, Tile> {
  using Base = PairPanels<V, Tile>;
  using typename Base::Number;
  using Session = typename Tile::Session;
  using Base::kDepth, Base::kPanel;
  static constexpr int kTile = 32, kRows = 64, kPart = 32, kKeys = 256;
  static constexpr bool kBeside = true;  // products are queued and computed while other work runs
  static constexpr RoundedLayout kRounded = RoundedLayout::tiles;

  /// Queued products, computed a step at a time between other work: the tile unit runs while vector instructions wait
  /// for each other. The processor looks about 500 instructions ahead, so steps are short.
  class Work {
   public:
    /// Queues c = a * panel, or c += a * panel if `sum`.
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
    /// Steps of all products queued since the last `finish`.
    int n_step() const { return n_step_; }
    /// Computes the next n steps, or all that are left.
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
    int n_waiting_ = 0, n_step_ = 0, first_ = 0, step_ = 0;  // step_: within the first queued product
    Tile tile_;
  };
};

}  // namespace vla::kernels
