// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/gelu_erf.h"
#include "kernels/linear_panels.h"
#include "kernels/numbers.h"
#include "kernels/rounded.h"
#include "kernels/sizes.h"

/// Shared by all product loops: how a job is split into stripes and tiles, and the epilogue.
namespace vla::kernels {

/// The columns of one panel by the rows of a block of x, over a part of the depth.
struct Stripe {
  int part;
  std::int64_t column, n_column, row = 0, n_row = 0, k = 0, depth = 0;
  float* gates = nullptr;  // [kColumns] x n_row
};

/// `Tile`: see the loop. It has a distinct type in each file, so that the linker cannot merge functions compiled for
/// different instructions. kLayout: how store_rounded of the tile stores y as bf16: one vector at a time, or a row at a
/// time if two vectors are kColumns wide.
template <class Tile, RoundedLayout kLayout = RoundedLayout::none>
struct LinearStripes {
  using V = typename Tile::V;
  static constexpr std::int64_t kRows = Tile::kRows, kColumns = Tile::kColumns;

  /// Panels in a job. The gate's panels are not counted separately.
  static std::int64_t n_panel(const LinearJob& job) {
    std::int64_t n = 0;
    for (int i = first_part(job); i < job.n_part; ++i) n += ceil_div(job.part[i].d_out, kColumns);
    return n;
  }

  /// The part and columns of panel `panel` of a job. The caller fills in the rest of the stripe.
  static Stripe of_panel(const LinearJob& job, std::int64_t panel) {
    int part = first_part(job);
    for (; panel >= ceil_div(job.part[part].d_out, kColumns); ++part) panel -= ceil_div(job.part[part].d_out, kColumns);
    const std::int64_t column = panel * kColumns;
    return {.part = part, .column = column, .n_column = min(kColumns, job.part[part].d_out - column)};
  }

  /// A part's panel at a column, starting at depth k.
  static const std::byte* panel_of(const LinearJob& job, const LinearJob::Part& part, std::int64_t column,
                                   std::int64_t k) {
    using Layout = Panels<kColumns>;
    return part.weight + column / kColumns * Layout::size(part.type, round_up(job.d_in, kPanelDepth)) +
           Layout::size(part.type, k);
  }

  /// The address of the weights that an item reads after panel `panel` at depths k to k + depth. An item takes panels
  /// begin to end for one block of the depth, then for the next. After its last block, the address is where the next
  /// item starts.
  static const std::byte* behind(const LinearJob& job, std::int64_t begin, std::int64_t end, std::int64_t panel,
                                 std::int64_t k, std::int64_t depth) {
    const bool ends_block = panel + 1 == end, goes_on = ends_block && k + depth < job.d_in;
    const std::int64_t next = goes_on ? begin : panel + 1;
    if (next == n_panel(job)) return job.part[0].weight;
    const Stripe s = of_panel(job, next);
    return panel_of(job, job.part[job.gated ? 0 : s.part], s.column, goes_on ? k + depth : ends_block ? 0 : k);
  }

  /// The first row of tile t of `n_row` rows. Tiles have nearly equal heights, or are full except for the last.
  static VLA_INLINE std::int64_t first_row(std::int64_t n_row, std::int64_t t) {
    return Tile::kEven ? n_row * t / ceil_div(n_row, kRows) : min(t * kRows, n_row);
  }

  /// Prefetches what finish() reads and writes for a tile.
  static VLA_INLINE void fetch(const LinearJob& job, const Stripe& s, std::int64_t r, std::int64_t n_row) {
    const LinearJob::Part& part = job.part[s.part];
    const std::int64_t place = (s.row + r) * part.d_out + s.column, size = number_size(part.y_type);
    fetch<1>(part.y + place * size, n_row, part.d_out * size);
    if (s.k + s.depth == job.d_in && part.residual != nullptr)
      fetch<0>(reinterpret_cast<const std::byte*>(part.residual + place), n_row, part.d_out * 4);
  }

  /// Finishes a tile's sums [kColumns] x n_row, rows first to first + n_row of the stripe: applies the epilogue after
  /// the last block of the depth, stores partial sums in y after earlier blocks. Rows of a tile may be finished in
  /// several calls.
  class Finish {
   public:
    Finish() = default;
    Finish(const LinearJob& job, const Stripe& s, const float* sums, std::int64_t first, std::int64_t n_row)
        : job_(&job),
          s_(s),
          sums_(sums),
          first_(first),
          n_row_(n_row),
          d_out_(job.part[s.part].d_out),
          y_(reinterpret_cast<float*>(job.part[s.part].y)) {
      rows_ = s.n_column == kColumns ? choose<true>() : choose<false>();
    }

    VLA_INLINE void operator()(std::int64_t begin, std::int64_t end) const { (this->*rows_)(begin, end); }

    /// Prefetches the floats that rows begin to end read and write; skips rows after the last one.
    VLA_INLINE void fetch(std::int64_t begin, std::int64_t end) const {
      end = min(end, n_row_);
      if (begin < end && job_->part[s_.part].y_type == DType::f32)
        LinearStripes::fetch(*job_, s_, first_ + begin, end - begin);
    }

   private:
    using Rows = void (Finish::*)(std::int64_t begin, std::int64_t end) const;

    /// kWhole: the stripe is kColumns wide.
    template <bool kWhole>
    Rows choose() {
      if (s_.k + s_.depth < job_->d_in) return &Finish::write<kWhole, false, Activation::none>;
      const LinearJob::Part &part = job_->part[s_.part], &gate = job_->part[0];
      const auto at_column = [&](const float* vector) { return vector != nullptr ? vector + s_.column : nullptr; };
      bias_ = at_column(part.bias), factor_ = at_column(part.factor), residual_ = part.residual;
      ends_in_relu_ = job_->ends_in_relu;
      if (job_->gated) gates_ = s_.gates, gate_bias_ = at_column(gate.bias);
      if constexpr (kLayout != RoundedLayout::none)
        if (part.y_type == DType::bf16) return activated<kWhole, true>();
      return activated<kWhole, false>();
    }

    template <bool kWhole, bool kRounded>
    Rows activated() const {
      switch (job_->activation) {
        case Activation::none:
          break;
        case Activation::gelu_tanh:
          return &Finish::write<kWhole, kRounded, Activation::gelu_tanh>;
        case Activation::gelu_erf:
          return &Finish::write<kWhole, kRounded, Activation::gelu_erf>;
        case Activation::silu:
          return &Finish::write<kWhole, kRounded, Activation::silu>;
        case Activation::relu:
          return &Finish::write<kWhole, kRounded, Activation::relu>;
        case Activation::relu_squared:
          return &Finish::write<kWhole, kRounded, Activation::relu_squared>;
        case Activation::mish:
          return &Finish::write<kWhole, kRounded, Activation::mish>;
      }
      return &Finish::write<kWhole, kRounded, Activation::none>;
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
      if constexpr (kActivation == Activation::relu_squared) return relu_squared<V>(x);
      if constexpr (kActivation == Activation::mish) return mish<V>(x);
      return x;
    }

    template <bool kWhole, bool kRounded, Activation kActivation>
    void write(std::int64_t begin, std::int64_t end) const {
      const Finish own = *this;  // local copies, which no store through a pointer can change
      own.write_rows<kWhole, kRounded, kActivation>(begin, end);
    }

    template <bool kWhole, bool kRounded, Activation kActivation>
    VLA_INLINE void write_rows(std::int64_t begin, std::int64_t end) const {
      for (std::int64_t i_row = begin; i_row < end; ++i_row) {
        const std::int64_t row = s_.row + first_ + i_row;
        [[maybe_unused]] std::uint16_t* to = nullptr;
        if constexpr (kRounded) to = rounded_row<kWhole>(row, d_out_);
        if constexpr (kRounded && kWhole && kColumns == 2 * V::width && kLayout == RoundedLayout::tiles) {
          Tile::store_rounded(to, value_at<true, true, kActivation>(i_row, 0),
                              value_at<true, true, kActivation>(i_row, V::width));
          continue;
        }
        for (std::int64_t i = 0; i < (kWhole ? kColumns : s_.n_column); i += V::width) {
          const std::int64_t left = kWhole ? V::width : s_.n_column - i;
          const typename V::Float value = value_at<kWhole, kRounded, kActivation>(i_row, i);
          if constexpr (kRounded)
            Tile::store_rounded(to + i, value, left);
          else
            store<V>(y_ + row * d_out_ + s_.column + i, value, left);
        }
      }
    }

    /// The finished values of a row, starting at column i.
    template <bool kWhole, bool kRounded, Activation kActivation>
    VLA_INLINE typename V::Float value_at(std::int64_t i_row, std::int64_t i) const {
      const std::int64_t r = first_ + i_row, place = (s_.row + r) * d_out_ + s_.column + i;
      const std::int64_t left = kWhole ? V::width : s_.n_column - i;
      typename V::Float value = V::load(sums_ + i_row * kColumns + i);
      if (s_.k > 0) value += load<V>(y_ + place, left);
      if (bias_ != nullptr) value += load<V>(bias_ + i, left);
      if (gates_ != nullptr) {
        typename V::Float gate = V::load(gates_ + r * kColumns + i);
        if (gate_bias_ != nullptr) gate += load<V>(gate_bias_ + i, left);
        value *= activate<kRounded, kActivation>(gate);
      } else {
        value = activate<kRounded, kActivation>(value);
      }
      if (factor_ != nullptr) value *= load<V>(factor_ + i, left);
      if (residual_ != nullptr) value += load<V>(residual_ + place, left);
      if (ends_in_relu_) value = relu<V>(value);
      return value;
    }

    /// The address where a row's elements of the stripe are stored as bf16.
    template <bool kWhole>
    VLA_INLINE std::uint16_t* rounded_row(std::int64_t row, std::int64_t d_out) const {
      auto* y = reinterpret_cast<std::uint16_t*>(y_);
      if constexpr (kLayout == RoundedLayout::rows) return y + row * d_out + s_.column;
      y += place_in_tiles(row, s_.column, d_out);
      if constexpr (!kWhole) std::memset(y, 0, kTileSide * sizeof(*y));  // columns after the last one
      return y;
    }

    Rows rows_ = nullptr;
    const LinearJob* job_ = nullptr;
    Stripe s_ = {};
    const float* sums_ = nullptr;
    std::int64_t first_ = 0, n_row_ = 0, d_out_ = 0;
    float* y_ = nullptr;
    // The operands of the epilogue, null for missing ones.
    const float *bias_ = nullptr, *factor_ = nullptr, *residual_ = nullptr, *gates_ = nullptr, *gate_bias_ = nullptr;
    bool ends_in_relu_ = false;
  };

  /// Finishes all rows of a tile.
  static void finish(const LinearJob& job, const Stripe& s, const float* sums, std::int64_t r, std::int64_t n_row) {
    Finish(job, s, sums, r, n_row)(0, n_row);
  }

 private:
  static int first_part(const LinearJob& job) { return job.gated ? 1 : 0; }

  /// Prefetches a tile's lines for reading, or writing (kWrite = 1).
  template <int kWrite>
  static VLA_INLINE void fetch(const std::byte* tile, std::int64_t n_row, std::int64_t stride) {
    for (std::int64_t r = 0; r < n_row; ++r)
      for (std::int64_t n = 0; n < kColumns; n += 16) __builtin_prefetch(tile + r * stride + 4 * n, kWrite);
  }
};

}  // namespace vla::kernels
