// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <limits>
#include <type_traits>

#include "kernels/attention_kernel.h"
#include "kernels/attention_products.h"
#include "kernels/math.h"

/// Attention with an online softmax. Rows of a block (queries of every head that shares keys) meet the keys in chunks:
/// a chunk's scores lie in the first cache, become weights there, and are mixed into the block's output, which is
/// scaled down whenever a larger score turns up.
/// Source of the method: Dao et al., FlashAttention (2022); Milakov and Gimelshein, Online normalizer (2018).
namespace vla::kernels {

/// `P` is a type of attention_products.h.
template <class P>
class AttentionTile {
  using V = typename P::Vector;
  using Float = typename V::Float;
  using Number = typename P::Number;
  static constexpr int kWidth = V::width, kTile = P::kTile, kPanel = P::kPanel;
  static constexpr int kRows = P::kRows;  // rows of a block, a multiple of kTile
  static constexpr int kKeys = 128;       // keys of a chunk, a multiple of kPanel
  // Rows lie a little apart from powers of two, so that they do not compete for the same lines of the cache.
  static constexpr int kHeadStride = kMaxHead + 32, kKeyStride = kKeys + 32;
  static constexpr float kNever = -std::numeric_limits<float>::infinity();
  static_assert(kRows % kTile == 0 && kKeys % kPanel == 0 && kPanel % (2 * kWidth) == 0 && kPanel % P::kDepth == 0);

  static std::int64_t round_up(std::int64_t n, std::int64_t unit) { return (n + unit - 1) / unit * unit; }
  static std::int64_t n_key_padded(const AttentionJob& job) { return round_up(job.n_key, kPanel); }
  static std::int64_t key_depth(const AttentionJob& job) { return round_up(job.d_head, P::kDepth); }
  static std::int64_t d_padded(const AttentionJob& job) { return round_up(job.d_head, P::kLeastPanel); }
  static std::int64_t unit_size(const AttentionJob& job) {
    return n_key_padded(job) * (key_depth(job) + d_padded(job));
  }
  static Number* packed_keys(const AttentionJob& job, std::int64_t unit) {
    return reinterpret_cast<Number*>(job.packed) + unit * unit_size(job);
  }
  static Number* packed_values(const AttentionJob& job, std::int64_t unit) {
    return packed_keys(job, unit) + n_key_padded(job) * key_depth(job);
  }
  /// Columns of the panel of values that starts at feature i.
  static std::int64_t panel_width(const AttentionJob& job, std::int64_t i) {
    return d_padded(job) - i < kPanel ? P::kLeastPanel : kPanel;
  }

 public:
  static std::int64_t packed_size(const AttentionJob& job) {
    return job.n_unit() * unit_size(job) * static_cast<std::int64_t>(sizeof(Number)) / 4 + 1;
  }

  static void pack(const AttentionJob& job, int ith, int nth) {
    const std::int64_t n_panel = n_key_padded(job) / kPanel, n = job.n_unit() * n_panel;
    for (std::int64_t i = n * ith / nth; i < n * (ith + 1) / nth; ++i) {
      pack_keys(job, i / n_panel, i % n_panel * kPanel);
      pack_values(job, i / n_panel, i % n_panel * kPanel);
    }
  }

  static void run(const AttentionJob& job, int ith, int nth) {
    [[maybe_unused]] typename P::Session session;
    // Blocks are made smaller where there would be too few of them to share out.
    const std::int64_t fair = round_up(job.n_row() * job.n_unit() / (4 * nth) + 1, kTile);
    const std::int64_t n_row = fair < kRows ? fair : kRows;
    const std::int64_t n_block = round_up(job.n_row(), n_row) / n_row, n = n_block * job.n_unit();
    for (std::int64_t i = n * ith / nth; i < n * (ith + 1) / nth; ++i) {
      const std::int64_t row = i % n_block * n_row, left = job.n_row() - row;
      Block(job, i / n_block, row, static_cast<int>(left < n_row ? left : n_row)).run();
    }
  }

 private:
  /// The d_head numbers of a row, or of none, and zeros up to `n_padded`.
  static VLA_INLINE void copy_row(const AttentionJob& job, const float* from, std::int64_t n_padded, Number* to) {
    for (std::int64_t i = 0; i < n_padded; i += kWidth)
      P::store(to + i, from != nullptr && i < job.d_head ? load<V>(from + i, job.d_head - i) : Float{});
  }

  static constexpr std::int64_t kRowStride = kMaxHead + kWidth;  // of rows on their way into panels

  /// Keys or values of kPanel tokens from `first` on, as numbers and padded to `n_padded`; missing tokens are zeros.
  /// The tokens after them are asked for: they are too far apart for the machine to foresee.
  static VLA_INLINE void copy_rows(const AttentionJob& job, const AttentionJob::Rows& from, std::int64_t unit,
                                   std::int64_t first, std::int64_t n_padded, Number* rows) {
    const std::int64_t head = unit % job.n_head_kv, batch = unit / job.n_head_kv;
    for (std::int64_t j = 0; j < kPanel; ++j) {
      copy_row(job, first + j < job.n_key ? from.at(head, first + j, batch) : nullptr, n_padded, rows + j * kRowStride);
      if (first + kPanel + j >= job.n_key) continue;
      const float* next = from.at(head, first + kPanel + j, batch);
      for (std::int64_t i = 0; i < job.d_head; i += 16) __builtin_prefetch(next + i);
    }
  }

  /// A panel of kPanel keys: its depth is the width of a head.
  static void pack_keys(const AttentionJob& job, std::int64_t unit, std::int64_t first) {
    const std::int64_t depth = key_depth(job);
    Number* panel = packed_keys(job, unit) + first * depth;
    Number rows[kPanel * kRowStride];
    copy_rows(job, job.k, unit, first, depth, rows);
    for (std::int64_t i = 0; i < depth; ++i)
      for (std::int64_t j = 0; j < kPanel; ++j) panel[P::place(i, j, kPanel)] = rows[j * kRowStride + i];
  }

  /// kPanel values of every panel of features: the depth of those is the number of keys.
  static void pack_values(const AttentionJob& job, std::int64_t unit, std::int64_t first) {
    const std::int64_t d = d_padded(job);
    Number rows[kPanel * kRowStride];
    copy_rows(job, job.v, unit, first, d, rows);
    for (std::int64_t i = 0; i < d; i += kPanel) {
      Number* panel = packed_values(job, unit) + i * n_key_padded(job);
      if (panel_width(job, i) == kPanel)
        put_values<kPanel>(rows + i, first, panel);
      else
        put_values<P::kLeastPanel>(rows + i, first, panel);
    }
  }

  template <int kColumns>
  static VLA_INLINE void put_values(const Number* rows, std::int64_t first, Number* panel) {
    for (std::int64_t j = 0; j < kPanel; ++j)
      for (std::int64_t n = 0; n < kColumns; ++n) panel[P::place(first + j, n, kColumns)] = rows[j * kRowStride + n];
  }

  /// At most kRows rows of one unit.
  struct Block {
    const AttentionJob& job;
    const std::int64_t first_row, batch, first_head;
    const Number *keys, *values;
    const int n_row;
    const int n_tiled = static_cast<int>(round_up(n_row, kTile));
    alignas(64) float mixed[kRows * kHeadStride];
    alignas(64) float score[kRows * kKeyStride];
    alignas(64) Number query[kRows * kHeadStride];
    // Weights take the place of the scores, unless they are numbers of another kind.
    static constexpr bool kInPlace = std::is_same_v<Number, float>;
    alignas(64) Number rounded_weight[kInPlace ? 1 : kRows * kKeyStride];
    alignas(64) float sum[kRows * kWidth];  // of a row's weights, lane by lane
    // One number for each row, with room for whole vectors.
    static constexpr int kRowVectors = (kRows + kWidth - 1) / kWidth * kWidth;
    alignas(64) float most[kRowVectors], top_score[kRowVectors], minus_offset[kRowVectors], shrink[kRowVectors];

    VLA_INLINE Block(const AttentionJob& j, std::int64_t unit, std::int64_t first, int n)
        : job(j),
          first_row(first),
          batch(unit / j.n_head_kv),
          first_head(unit % j.n_head_kv * (j.n_head / j.n_head_kv)),
          keys(packed_keys(j, unit)),
          values(packed_values(j, unit)),
          n_row(n) {}

    std::int64_t query_of(int row) const { return (first_row + row) % job.n_query; }
    std::int64_t head_of(int row) const { return first_head + (first_row + row) / job.n_query; }
    Number* weights() {
      if constexpr (kInPlace)
        return score;
      else
        return rounded_weight;
    }

    void run() {
      start();
      for (std::int64_t key = 0; key < job.n_key; key += kKeys) {
        const int n = static_cast<int>(job.n_key - key < kKeys ? job.n_key - key : kKeys);
        const Seen seen = job.mask == nullptr ? Seen::all : look(key, n);
        if (seen == Seen::none) continue;
        multiply_keys(key, n);
        if (seen == Seen::some) apply_mask(key, n);
        weigh(n, seen == Seen::some ? 1.0f : job.scale);
        mix_values(key, n);
      }
      finish();
    }

    void start() {
      for (int r = 0; r < n_tiled; ++r) {
        copy_row(job, r < n_row ? job.q.at(head_of(r), query_of(r), batch) : nullptr, key_depth(job),
                 query + r * kHeadStride);
        std::memset(mixed + r * kHeadStride, 0, static_cast<std::size_t>(d_padded(job)) * sizeof(float));
        V::store(sum + r * kWidth, Float{});
      }
      for (int r = 0; r < kRowVectors; ++r) most[r] = top_score[r] = kNever;
      if constexpr (!kInPlace)  // rows beyond n_row are multiplied too
        std::memset(rounded_weight, 0, sizeof(rounded_weight));
    }

    enum class Seen { none, some, all };
    /// What the block's queries see of a chunk.
    Seen look(std::int64_t key, int n) const {
      bool none = true, all = true;
      for (int r = 0; r < n_row && (none || all); ++r) {
        const float* mask = job.mask + query_of(r) * job.n_key + key;
        Float most_seen = V::set(mask[0]), least_seen = V::set(-mask[0]);
        int j = 0;
        for (; j + kWidth <= n; j += kWidth) {
          most_seen = V::max(most_seen, V::load(mask + j));
          least_seen = V::max(least_seen, -V::load(mask + j));
        }
        float top = V::max(most_seen), bottom = -V::max(least_seen);
        for (; j < n; ++j) top = mask[j] > top ? mask[j] : top, bottom = mask[j] < bottom ? mask[j] : bottom;
        none = none && top == kNever;
        all = all && top == 0.0f && bottom == 0.0f;
      }
      return all ? Seen::all : none ? Seen::none : Seen::some;
    }

    void multiply_keys(std::int64_t key, int n) {
      const std::int64_t depth = key_depth(job);
      for (int j = 0; j < n; j += kPanel)
        for (int r = 0; r < n_tiled; r += kTile)
          P::template multiply<kHeadStride, kKeyStride, false>(query + r * kHeadStride, keys + (key + j) * depth, depth,
                                                               kPanel, score + r * kKeyStride + j);
      for (int r = 0; r < n_row; ++r)
        for (int j = n; j < round_up(n, kPanel); ++j) score[r * kKeyStride + j] = kNever;
    }

    void apply_mask(std::int64_t key, int n) {
      const Float scale = V::set(job.scale);
      for (int r = 0; r < n_row; ++r) {
        const float* mask = job.mask + query_of(r) * job.n_key + key;
        float* row = score + r * kKeyStride;
        for (int j = 0; j < n; j += kWidth)
          V::store(row + j, V::fma(V::load(row + j), scale, load<V>(mask + j, n - j)));
      }
    }

    /// Scores become weights relative to the greatest score so far; what was mixed before shrinks accordingly.
    void weigh(int n, float scale) {
      for (int r = 0; r < n_row; ++r) {
        const float* row = score + r * kKeyStride;
        Float top = V::load(row);
        for (int j = kWidth; j < n; j += kWidth) top = V::max(top, V::load(row + j));
        top_score[r] = V::max(top) * scale;
      }
      for (int r = 0; r < kRowVectors; r += kWidth) {
        const Float before = V::load(most + r), now = V::max(V::load(top_score + r), before);
        // A row that saw nothing yet has no greatest score; any finite one keeps its weights at zero.
        const Float offset = now == kNever ? Float{} : now;
        V::store(most + r, now);
        V::store(minus_offset + r, -offset);
        V::store(shrink + r, exp_of_negative<V>(before - offset));
      }
      for (int r = 0; r < n_row; ++r) {
        weigh_row(score + r * kKeyStride, weights() + r * kKeyStride, n, scale, r);
        if (shrink[r] != 1.0f) shrink_row(mixed + r * kHeadStride, shrink[r]);
      }
    }

    VLA_INLINE void weigh_row(const float* row, Number* weight, int n, float scale, int r) {
      const Float factor = V::set(scale), offset = V::set(minus_offset[r]);
      Float even = V::load(sum + r * kWidth) * shrink[r], odd = {};
      for (int j = 0; j < round_up(n, kPanel); j += 2 * kWidth) {
        const Float a = exp_of_negative<V>(V::fma(V::load(row + j), factor, offset));
        const Float b = exp_of_negative<V>(V::fma(V::load(row + j + kWidth), factor, offset));
        P::store(weight + j, a);
        P::store(weight + j + kWidth, b);
        even += a;
        odd += b;
      }
      V::store(sum + r * kWidth, even + odd);
    }

    VLA_INLINE void shrink_row(float* row, float factor) {
      for (std::int64_t i = 0; i < d_padded(job); i += kWidth) V::store(row + i, V::load(row + i) * factor);
    }

    void mix_values(std::int64_t key, int n) {
      const std::int64_t depth = round_up(n, P::kDepth);
      for (std::int64_t i = 0; i < d_padded(job); i += kPanel) {
        const std::int64_t width = panel_width(job, i);
        const Number* panel = values + i * n_key_padded(job) + key * width;
        for (int r = 0; r < n_tiled; r += kTile)
          P::template multiply<kKeyStride, kHeadStride, true>(weights() + r * kKeyStride, panel, depth, width,
                                                              mixed + r * kHeadStride + i);
      }
    }

    void finish() {
      for (int r = 0; r < n_row; ++r) {
        const std::int64_t place = batch * job.n_query + query_of(r);
        float* out = job.out + (place * job.n_head + head_of(r)) * job.d_head;
        const float* row = mixed + r * kHeadStride;
        const float total = V::sum(V::load(sum + r * kWidth));
        for (std::int64_t i = 0; i < job.d_head; i += kWidth)
          store<V>(out + i, V::load(row + i) / total, job.d_head - i);
      }
    }
  };
};

}  // namespace vla::kernels
