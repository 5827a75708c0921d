// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/gelu_erf.h"
#include "kernels/linear_job.h"
#include "kernels/numbers.h"
#include "kernels/sizes.h"

/// What the loops of products share: how a job is cut into stripes and tiles, and everything that follows a product.
namespace vla::kernels {

/// One panel's columns of a part by the rows of a block of x, over a part of the depth.
struct Stripe {
  int part;
  std::int64_t column, n_column, row, n_row, k, depth;
  float* gates;  // [kColumns] x n_row
};

/// `Tile` as linear_loop.h describes it. It has a type of its own in each file, so that the linker cannot merge what
/// was compiled for different instructions.
template <class Tile>
struct LinearStripes {
  using V = typename Tile::V;
  static constexpr std::int64_t kRows = Tile::kRows, kColumns = Tile::kColumns;

  /// Panels of a job. The gate is no part of its own.
  static std::int64_t n_panel(const LinearJob& job) {
    std::int64_t n = 0;
    for (int i = first_part(job); i < job.n_part; ++i) n += ceil_div(job.part[i].d_out, kColumns);
    return n;
  }

  /// The part and the columns of panel `panel` of a job; the rest of the stripe is to be filled in.
  static Stripe of_panel(const LinearJob& job, std::int64_t panel) {
    int part = first_part(job);
    for (; panel >= ceil_div(job.part[part].d_out, kColumns); ++part) panel -= ceil_div(job.part[part].d_out, kColumns);
    const std::int64_t column = panel * kColumns;
    return {part, column, min(kColumns, job.part[part].d_out - column), 0, 0, 0, 0, nullptr};
  }

  /// Where tile t of `n_row` rows begins: tiles are of nearly equal height, or whole but for the last.
  static VLA_INLINE std::int64_t first_row(std::int64_t n_row, std::int64_t t) {
    return Tile::kEven ? n_row * t / ceil_div(n_row, kRows) : min(t * kRows, n_row);
  }

  /// Asks for what finish() will read and write of a tile.
  static VLA_INLINE void fetch(const LinearJob& job, const Stripe& s, std::int64_t r, std::int64_t n_row) {
    const LinearJob::Part& part = job.part[s.part];
    const std::int64_t place = (s.row + r) * part.d_out + s.column, size = number_size(job.y_type);
    fetch<1>(part.y + place * size, n_row, part.d_out * size);
    if (s.k + s.depth == job.d_in && part.residual != nullptr)
      fetch<0>(reinterpret_cast<const std::byte*>(part.residual + place), n_row, part.d_out * 4);
  }

  /// What becomes of a tile's sums [kColumns] x n_row, rows r to r + n_row of the stripe: behind the last block of the
  /// depth everything that follows the product, before it partial sums in y.
  static void finish(const LinearJob& job, const Stripe& s, const float* sums, std::int64_t r, std::int64_t n_row) {
    const LinearStripes stripes = {job, s, sums, r, n_row};
    s.n_column == kColumns ? stripes.template finish<true>() : stripes.template finish<false>();
  }

  const LinearJob& job;
  const Stripe& s;
  const float* sums;
  const std::int64_t first, n_row;

 private:
  static int first_part(const LinearJob& job) { return job.gated ? 1 : 0; }

  /// Lines of a tile that will be read, or written (kWrite = 1), when the product is there.
  template <int kWrite>
  static VLA_INLINE void fetch(const std::byte* tile, std::int64_t n_row, std::int64_t stride) {
    for (std::int64_t r = 0; r < n_row; ++r)
      for (std::int64_t n = 0; n < kColumns; n += 16) __builtin_prefetch(tile + r * stride + 4 * n, kWrite);
  }

  /// kWhole: the stripe is kColumns wide.
  template <bool kWhole>
  void finish() const {
    if (s.k + s.depth < job.d_in) return write<kWhole, false, Activation::none>({});
    const LinearJob::Part &part = job.part[s.part], &gate = job.part[0];
    const After after = {part.bias != nullptr ? part.bias + s.column : nullptr,
                         part.factor != nullptr ? part.factor + s.column : nullptr, part.residual,
                         job.gated ? s.gates : nullptr,
                         job.gated && gate.bias != nullptr ? gate.bias + s.column : nullptr};
    if constexpr (Tile::kRounds)
      if (job.y_type == DType::bf16) return write_activated<kWhole, true>(after);
    write_activated<kWhole, false>(after);
  }

  /// What follows a product beside its activation; null where nothing does.
  struct After {
    const float *bias = nullptr, *factor = nullptr, *residual = nullptr, *gates = nullptr, *gate_bias = nullptr;
  };

  template <bool kWhole, bool kRounded>
  void write_activated(const After& after) const {
    switch (job.activation) {
      case Activation::none:
        return write<kWhole, kRounded, Activation::none>(after);
      case Activation::gelu_tanh:
        return write<kWhole, kRounded, Activation::gelu_tanh>(after);
      case Activation::gelu_erf:
        return write<kWhole, kRounded, Activation::gelu_erf>(after);
      case Activation::silu:
        return write<kWhole, kRounded, Activation::silu>(after);
      case Activation::relu:
        return write<kWhole, kRounded, Activation::relu>(after);
      case Activation::relu_squared:
        return write<kWhole, kRounded, Activation::relu_squared>(after);
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
    if constexpr (kActivation == Activation::relu_squared) return relu_squared<V>(x);
    return x;
  }

  template <bool kWhole, bool kRounded, Activation kActivation>
  void write(const After& after) const {
    const LinearJob::Part& part = job.part[s.part];
    for (std::int64_t i_row = 0; i_row < n_row; ++i_row) {
      const std::int64_t r = first + i_row, row = (s.row + r) * part.d_out + s.column;
      for (std::int64_t i = 0; i < (kWhole ? kColumns : s.n_column); i += V::width) {
        const std::int64_t left = kWhole ? V::width : s.n_column - i;
        float* y = reinterpret_cast<float*>(part.y) + row + i;
        typename V::Float value = V::load(sums + i_row * kColumns + i);
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
          Tile::store_rounded(reinterpret_cast<typename Tile::X*>(part.y) + row + i, value, left);
        else
          store<V>(y, value, left);
      }
    }
  }
};

}  // namespace vla::kernels
