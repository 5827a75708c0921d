// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <limits>

#include "kernels/attention_kernel.h"
#include "kernels/math.h"

/// Attention with an online softmax. Rows of a block (queries of every head that shares keys) meet the keys in chunks:
/// a chunk's scores lie in the first cache, become weights there, and are mixed into the block's output, which is
/// scaled down whenever a larger score turns up. Both products are the same register tile: kTile rows times two
/// vectors, with one operand broadcast and the other from panels that `pack` lays out.
/// Source of the method: Dao et al., FlashAttention (2022); Milakov and Gimelshein, Online normalizer (2018).
namespace vla::kernels {

template <class V, int kTile>
class AttentionTile {
  using Float = typename V::Float;
  static constexpr int kWidth = V::width, kPanel = 2 * kWidth;
  static constexpr int kRows = 24;   // rows of a block, a multiple of kTile
  static constexpr int kKeys = 128;  // keys of a chunk, a multiple of kPanel
  // Rows lie a little apart from powers of two, so that they do not compete for the same lines of the cache.
  static constexpr int kHeadStride = kMaxHead + 16, kKeyStride = kKeys + 16;
  static_assert(kRows % kTile == 0 && kKeys % kPanel == 0);

  static std::int64_t round_up(std::int64_t n, std::int64_t unit) { return (n + unit - 1) / unit * unit; }
  static std::int64_t n_key_padded(const AttentionJob& job) { return round_up(job.n_key, kPanel); }
  static std::int64_t d_padded(const AttentionJob& job) { return round_up(job.d_head, kWidth); }
  static std::int64_t unit_size(const AttentionJob& job) { return n_key_padded(job) * (job.d_head + d_padded(job)); }

 public:
  static std::int64_t packed_size(const AttentionJob& job) { return job.n_unit() * unit_size(job); }

  static void pack(const AttentionJob& job, int ith, int nth) {
    const std::int64_t n_panel = n_key_padded(job) / kPanel, n = job.n_unit() * n_panel;
    for (std::int64_t i = n * ith / nth; i < n * (ith + 1) / nth; ++i) {
      pack_keys(job, i / n_panel, i % n_panel);
      pack_values(job, i / n_panel, i % n_panel);
    }
  }

  static void run(const AttentionJob& job, int ith, int nth) {
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
  /// Keys as panels [kPanel, d_head]: element i of kPanel keys lies together. Missing keys are zeros.
  static void pack_keys(const AttentionJob& job, std::int64_t unit, std::int64_t panel) {
    const std::int64_t head = unit % job.n_head_kv, batch = unit / job.n_head_kv, first = panel * kPanel;
    float* out = job.packed + unit * unit_size(job) + first * job.d_head;
    for (std::int64_t j = 0; j < kPanel; ++j) {
      const bool present = first + j < job.n_key;
      const float* row = present ? job.k.at(head, first + j, batch) : nullptr;
      for (std::int64_t i = 0; i < job.d_head; ++i) out[i * kPanel + j] = present ? row[i] : 0.0f;
    }
  }

  /// Values as panels [kPanel, n_key_padded] of kPanel features, the last of kWidth where that is enough.
  static void pack_values(const AttentionJob& job, std::int64_t unit, std::int64_t panel) {
    const std::int64_t head = unit % job.n_head_kv, batch = unit / job.n_head_kv, n_key = n_key_padded(job);
    float* out = job.packed + unit * unit_size(job) + n_key * job.d_head;
    for (std::int64_t key = panel * kPanel; key < (panel + 1) * kPanel; ++key)
      for (std::int64_t i = 0; i < job.d_head; i += kWidth) {
        const std::int64_t start = i / kPanel * kPanel, left = job.d_head - i;
        const std::int64_t width = d_padded(job) - start < kPanel ? kWidth : kPanel;
        V::store(out + start * n_key + key * width + i - start,
                 load<V>(job.v.at(head, key, batch) + i, key < job.n_key ? left : 0));
      }
  }

  /// sums[r][c] = sum over i of a[r * stride + i] * b[i * n_vec * width + c]
  template <int kVectors, int kStride>
  static VLA_INLINE void product(const float* a, const float* b, std::int64_t n, Float (&sums)[kTile][kVectors]) {
    for (int r = 0; r < kTile; ++r)
      for (int c = 0; c < kVectors; ++c) sums[r][c] = Float{};
#pragma GCC unroll 4
    for (std::int64_t i = 0; i < n; ++i) {
      Float column[kVectors];
      for (int c = 0; c < kVectors; ++c) column[c] = V::load(b + (i * kVectors + c) * kWidth);
#pragma GCC unroll 16
      for (int r = 0; r < kTile; ++r) {
        const Float row = V::set(a[r * kStride + i]);
        for (int c = 0; c < kVectors; ++c) sums[r][c] = V::fma(row, column[c], sums[r][c]);
      }
    }
  }

  /// At most kRows rows of one unit.
  struct Block {
    const AttentionJob& job;
    const std::int64_t first_row, batch, first_head;
    const float *keys, *values;
    const int n_row;
    const int n_tiled = static_cast<int>(round_up(n_row, kTile));
    alignas(64) float query[kRows * kHeadStride];
    alignas(64) float mixed[kRows * kHeadStride];
    alignas(64) float score[kRows * kKeyStride];
    alignas(64) float sum[kRows * kWidth];  // of a row's weights, lane by lane
    // One number for each row, with room for whole vectors.
    static constexpr int kRowVectors = (kRows + kWidth - 1) / kWidth * kWidth;
    alignas(64) float most[kRowVectors], top_score[kRowVectors], minus_offset[kRowVectors], shrink[kRowVectors];

    VLA_INLINE Block(const AttentionJob& j, std::int64_t unit, std::int64_t first, int n)
        : job(j),
          first_row(first),
          batch(unit / j.n_head_kv),
          first_head(unit % j.n_head_kv * (j.n_head / j.n_head_kv)),
          keys(j.packed + unit * unit_size(j)),
          values(keys + n_key_padded(j) * j.d_head),
          n_row(n) {}

    std::int64_t query_of(int row) const { return (first_row + row) % job.n_query; }
    std::int64_t head_of(int row) const { return first_head + (first_row + row) / job.n_query; }

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
        float* row = query + r * kHeadStride;
        if (r < n_row)
          std::memcpy(row, job.q.at(head_of(r), query_of(r), batch),
                      static_cast<std::size_t>(job.d_head) * sizeof(float));
        else
          std::memset(row, 0, static_cast<std::size_t>(job.d_head) * sizeof(float));
        std::memset(mixed + r * kHeadStride, 0, static_cast<std::size_t>(d_padded(job)) * sizeof(float));
        V::store(sum + r * kWidth, Float{});
      }
      for (int r = 0; r < kRowVectors; ++r) most[r] = top_score[r] = -std::numeric_limits<float>::infinity();
    }

    enum class Seen { none, some, all };
    /// What the block's queries see of a chunk.
    Seen look(std::int64_t key, int n) const {
      bool none = true, all = true;
      for (int r = 0; r < n_row; ++r) {
        const float* mask = job.mask + query_of(r) * job.n_key + key;
        for (int i = 0; i < n; ++i) {
          all = all && mask[i] == 0.0f;
          none = none && mask[i] == -std::numeric_limits<float>::infinity();
        }
        if (!none && !all) return Seen::some;
      }
      return all ? Seen::all : Seen::none;
    }

    void multiply_keys(std::int64_t key, int n) {
      for (int j = 0; j < n; j += kPanel)
        for (int r = 0; r < n_tiled; r += kTile) {
          Float sums[kTile][2];
          product<2, kHeadStride>(query + r * kHeadStride, keys + (key + j) * job.d_head, job.d_head, sums);
          for (int i = 0; i < kTile; ++i)
            for (int c = 0; c < 2; ++c) V::store(score + (r + i) * kKeyStride + j + c * kWidth, sums[i][c]);
        }
      for (int r = 0; r < n_row; ++r)
        for (int j = n; j < round_up(n, kPanel); ++j)
          score[r * kKeyStride + j] = -std::numeric_limits<float>::infinity();
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

    /// Scores become weights relative to the greatest score so far; what was mixed before has to shrink.
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
        const Float offset = now == -std::numeric_limits<float>::infinity() ? Float{} : now;
        V::store(most + r, now);
        V::store(minus_offset + r, -offset);
        V::store(shrink + r, exp_of_negative<V>(before - offset));
      }
      for (int r = 0; r < n_row; ++r) weigh_row(score + r * kKeyStride, n, scale, r);
    }

    VLA_INLINE void weigh_row(float* row, int n, float scale, int r) {
      const Float factor = V::set(scale), offset = V::set(minus_offset[r]);
      Float even = V::load(sum + r * kWidth) * shrink[r], odd = {};
      for (int j = 0; j < n; j += kPanel) {
        const Float a = exp_of_negative<V>(V::fma(V::load(row + j), factor, offset));
        const Float b = exp_of_negative<V>(V::fma(V::load(row + j + kWidth), factor, offset));
        V::store(row + j, a);
        V::store(row + j + kWidth, b);
        even += a;
        odd += b;
      }
      V::store(sum + r * kWidth, even + odd);
    }

    template <int kVectors>
    VLA_INLINE void mix_panel(const float* panel, int n, float* out) {
      for (int r = 0; r < n_tiled; r += kTile) {
        Float sums[kTile][kVectors];
        product<kVectors, kKeyStride>(score + r * kKeyStride, panel, n, sums);
        for (int i = 0; i < kTile; ++i)
          for (int c = 0; c < kVectors; ++c) {
            float* place = out + (r + i) * kHeadStride + c * kWidth;
            V::store(place, V::fma(V::load(place), V::set(shrink[r + i]), sums[i][c]));
          }
      }
    }

    void mix_values(std::int64_t key, int n) {
      const std::int64_t n_key = n_key_padded(job), d = d_padded(job);
      for (std::int64_t i = 0; i < d; i += kPanel)
        if (d - i < kPanel)
          mix_panel<1>(values + i * n_key + key * kWidth, n, mixed + i);
        else
          mix_panel<2>(values + i * n_key + key * kPanel, n, mixed + i);
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
