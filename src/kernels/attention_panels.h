// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/attention_products.h"
#include "kernels/sizes.h"

namespace vla::kernels {

/// Packed keys and values as the products read them. A unit has panels of keys, whose depth is the head's width,
/// followed by panels of features, whose depth is the number of keys. `P` is a type of attention_products.h.
template <class P>
class AttentionPanels {
  using V = typename P::Vector;
  using Float = typename V::Float;
  using Number = typename P::Number;
  static constexpr int kWidth = V::width, kPanel = P::kPanel;
  static_assert(kPanel % (2 * kWidth) == 0 && kPanel % P::kDepth == 0);

 public:
  AttentionPanels(std::int64_t head, std::int64_t count)
      : d_head(head),
        n_key(round_up(count, kPanel)),
        key_depth(round_up(head, P::kDepth)),
        d_value(round_up(head, P::kMinPanel)) {}

  const std::int64_t d_head;
  const std::int64_t n_key;      // keys, padded to whole panels
  const std::int64_t key_depth;  // elements of a key, padded to whole steps
  const std::int64_t d_value;    // columns in all panels of features

  /// Elements in one unit.
  std::int64_t unit_size() const { return n_key * (key_depth + d_value); }
  /// Offsets of a unit's keys and of its values.
  std::int64_t keys(std::int64_t unit) const { return unit * unit_size(); }
  std::int64_t values(std::int64_t unit) const { return keys(unit) + n_key * key_depth; }
  /// Columns in the panel of features that starts at feature i.
  std::int64_t width(std::int64_t i) const { return d_value - i < kPanel ? P::kMinPanel : kPanel; }

  static std::size_t packed_size(const PackJob& job) {
    return static_cast<std::size_t>(job.n_unit() * AttentionPanels(job.d_head, job.n_key).unit_size()) * sizeof(Number);
  }
  static std::int64_t n_pack(const PackJob& job) { return job.n_unit() * ceil_div(job.n_key, kPanel); }
  static void pack(const PackJob& job, std::int64_t item) {
    const AttentionPanels panels(job.d_head, job.n_key);
    const std::int64_t n_panel = panels.n_key / kPanel, unit = item / n_panel, first = item % n_panel * kPanel;
    Number* packed = reinterpret_cast<Number*>(job.packed);
    alignas(64) Number rows[kPanel * kHeadStride];
    panels.copy_rows(job, job.k, job.prep, unit, first, panels.key_depth, rows);
    P::put_keys(rows, panels.key_depth, packed + panels.keys(unit) + first * panels.key_depth);
    panels.copy_rows(job, job.v, {}, unit, first, panels.d_value, rows);
    for (std::int64_t i = 0; i < panels.d_value; i += kPanel)
      P::put_values(rows + i, first, panels.width(i), packed + panels.values(unit) + i * panels.n_key);
  }

  /// Writes a token's d_head elements, padded with zeros to `n_padded`. May write up to two vectors past the end.
  VLA_INLINE void copy_row(const HeadRows& rows, std::int64_t head, std::int64_t token, std::int64_t batch,
                           const RowPrep& prep, std::int64_t n_padded, Number* to) const {
    if constexpr (P::kRounded != RoundedLayout::none)
      if (rows.layout != RoundedLayout::none) return copy_rounded(rows, rows.place(head, token, batch), n_padded, to);
    alignas(64) float room[kMaxHead];
    copy_floats(prep(rows.at(head, token, batch), token, d_head, room), d_head, n_padded, to);
  }
  VLA_INLINE void copy_nothing(std::int64_t n_padded, Number* to) const { copy_floats(nullptr, 0, n_padded, to); }

 private:
  VLA_INLINE void copy_floats(const float* from, std::int64_t n, std::int64_t n_padded, Number* to) const {
    std::int64_t i = 0;
    for (; i + 2 * kWidth <= n; i += 2 * kWidth) P::store(to + i, V::load(from + i), V::load(from + i + kWidth));
    const auto part = [&](std::int64_t j) VLA_LAMBDA { return j < n ? load<V>(from + j, n - j) : Float{}; };
    for (; i < n_padded; i += 2 * kWidth) P::store(to + i, part(i), part(i + kWidth));
  }

  VLA_INLINE void copy_rounded(const HeadRows& rows, std::int64_t place, std::int64_t n_padded, Number* to) const {
    const auto* from = reinterpret_cast<const Number*>(rows.data);
    for_pieces(P::kRounded, place / rows.d, place % rows.d, d_head, rows.d,
               [&](std::int64_t i, std::int64_t at, std::int64_t n) VLA_LAMBDA {
                 if (n == kTileSide)  // a compile-time size
                   std::memcpy(to + i, from + at, kTileSide * sizeof(*to));
                 else
                   std::memcpy(to + i, from + at, static_cast<std::size_t>(n) * sizeof(*to));
               });
    if (d_head < n_padded) std::memset(to + d_head, 0, static_cast<std::size_t>(n_padded - d_head) * sizeof(*to));
  }

  /// Reads keys or values of kPanel tokens, starting at `first`, as elements padded to `n_padded`; missing tokens are
  /// zeros. It prefetches the next tokens, which are too far apart for the hardware prefetcher.
  VLA_INLINE void copy_rows(const PackJob& job, const HeadRows& from, const RowPrep& prep, std::int64_t unit,
                            std::int64_t first, std::int64_t n_padded, Number* rows) const {
    const std::int64_t head = unit % job.n_head_kv, batch = unit / job.n_head_kv;
    for (std::int64_t j = 0; j < kPanel; ++j) {
      const std::int64_t key = first + j;
      if (key < job.n_key)
        copy_row(from, head, key, batch, prep, n_padded, rows + j * kHeadStride);
      else
        copy_nothing(n_padded, rows + j * kHeadStride);
      if (key + kPanel >= job.n_key || from.layout != RoundedLayout::none) continue;
      const float* next = from.at(head, key + kPanel, batch);
      for (std::int64_t i = 0; i < d_head; i += 16) __builtin_prefetch(next + i);
    }
  }
};

}  // namespace vla::kernels
