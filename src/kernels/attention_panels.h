// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/attention_products.h"
#include "kernels/pieces.h"

namespace vla::kernels {

/// Keys and values of one job as the products read them: for each unit (a head of keys and values, of one batch) panels
/// of keys, whose depth is the width of a head, and behind them panels of features, whose depth is the number of keys.
/// `P` is a type of attention_products.h.
template <class P>
class AttentionPanels {
  using V = typename P::Vector;
  using Float = typename V::Float;
  using Number = typename P::Number;
  static constexpr int kWidth = V::width, kPanel = P::kPanel;
  static_assert(kPanel % (2 * kWidth) == 0 && kPanel % P::kDepth == 0);

 public:
  explicit AttentionPanels(const AttentionJob& j)
      : job(j),
        n_key(round_up(j.n_key, kPanel)),
        key_depth(round_up(j.d_head, P::kDepth)),
        d_value(round_up(j.d_head, P::kLeastPanel)) {}

  const AttentionJob& job;
  const std::int64_t n_key;      // keys with those that fill the last panel
  const std::int64_t key_depth;  // numbers of a key, with what fills up the depth
  const std::int64_t d_value;    // columns of all panels of features

  /// Numbers that one unit takes.
  std::int64_t unit_size() const { return n_key * (key_depth + d_value); }
  Number* keys(std::int64_t unit) const { return reinterpret_cast<Number*>(job.packed) + unit * unit_size(); }
  Number* values(std::int64_t unit) const { return keys(unit) + n_key * key_depth; }
  /// Columns of the panel of features that starts at feature i.
  std::int64_t width(std::int64_t i) const { return d_value - i < kPanel ? P::kLeastPanel : kPanel; }

  void pack(int ith, int nth) const {
    const std::int64_t n_panel = n_key / kPanel, n = job.n_unit() * n_panel;
    for (std::int64_t i = n * ith / nth; i < n * (ith + 1) / nth; ++i) {
      pack_keys(i / n_panel, i % n_panel * kPanel);
      pack_values(i / n_panel, i % n_panel * kPanel);
    }
  }

  /// The d_head numbers of a row, or of none, and zeros up to `n_padded`. What follows them in steps of two vectors is
  /// written too.
  VLA_INLINE void copy_row(const float* from, std::int64_t n_padded, Number* to) const {
    const std::int64_t n = from != nullptr ? job.d_head : 0;
    std::int64_t i = 0;
    for (; i + 2 * kWidth <= n; i += 2 * kWidth) P::store(to + i, V::load(from + i), V::load(from + i + kWidth));
    const auto part = [&](std::int64_t j) VLA_LAMBDA { return j < n ? load<V>(from + j, n - j) : Float{}; };
    for (; i < n_padded; i += 2 * kWidth) P::store(to + i, part(i), part(i + kWidth));
  }

 private:
  /// Keys or values of kPanel tokens from `first` on, as numbers and padded to `n_padded`; missing tokens are zeros.
  /// The tokens after them are asked for: they are too far apart for the machine to foresee.
  VLA_INLINE void copy_rows(const AttentionJob::Rows& from, std::int64_t unit, std::int64_t first,
                            std::int64_t n_padded, Number* rows) const {
    const std::int64_t head = unit % job.n_head_kv, batch = unit / job.n_head_kv;
    for (std::int64_t j = 0; j < kPanel; ++j) {
      copy_row(first + j < job.n_key ? from.at(head, first + j, batch) : nullptr, n_padded, rows + j * kHeadStride);
      if (first + kPanel + j >= job.n_key) continue;
      const float* next = from.at(head, first + kPanel + j, batch);
      for (std::int64_t i = 0; i < job.d_head; i += 16) __builtin_prefetch(next + i);
    }
  }

  void pack_keys(std::int64_t unit, std::int64_t first) const {
    alignas(64) Number rows[kPanel * kHeadStride];
    copy_rows(job.k, unit, first, key_depth, rows);
    P::put_keys(rows, key_depth, keys(unit) + first * key_depth);
  }

  void pack_values(std::int64_t unit, std::int64_t first) const {
    alignas(64) Number rows[kPanel * kHeadStride];
    copy_rows(job.v, unit, first, d_value, rows);
    for (std::int64_t i = 0; i < d_value; i += kPanel)
      P::put_values(rows + i, first, width(i), values(unit) + i * n_key);
  }
};

}  // namespace vla::kernels
