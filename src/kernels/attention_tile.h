// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <limits>

#include "kernels/attention_panels.h"

/// Attention with an online softmax. A block's rows are the queries of every head that shares keys. They are multiplied
/// by keys in chunks: a chunk's scores stay in the L1 and L2 caches, become weights there, and are added to the block's
/// output. The output is rescaled whenever a much larger score appears.
///
/// One pass computes some of the rows with one chunk. If a separate unit computes products (P::kBeside), the products
/// of neighbouring passes are computed while vector instructions turn scores into weights.
///
/// Source of the method: Dao et al., FlashAttention (2022); Milakov and Gimelshein, Online normalizer (2018).
namespace vla::kernels {

/// `P` is a type of attention_products.h.
template <class P>
class AttentionTile {
  using V = typename P::Vector;
  using Float = typename V::Float;
  using Number = typename P::Number;
  using Panels = AttentionPanels<P>;
  static constexpr int kWidth = V::width, kTile = P::kTile, kPanel = P::kPanel;
  static constexpr int kRows = P::kRows;  // rows of a block, a multiple of kPart
  static constexpr int kPart = P::kPart;  // rows of a pass, a multiple of kTile
  static constexpr int kKeys = P::kKeys;  // keys in a chunk, a multiple of kPanel
  static constexpr int kKeyStride = row_stride(kKeys);
  static constexpr float kNever = -std::numeric_limits<float>::infinity();
  static_assert(kRows % kPart == 0 && kPart % kTile == 0 && kKeys % kPanel == 0);

 public:
  static constexpr AttentionKernel kernel() {
    return {
        .packed_size = Panels::packed_size,
        .n_pack = Panels::n_pack,
        .pack = Panels::pack,
        .cut = cut,
        .run = run,
        .rounded = P::kRounded,
    };
  }

 private:
  static std::int64_t cut(AttentionJob& job, int n_thread) {
    // Makes blocks smaller if there are too few for all threads.
    const std::int64_t fair = round_up(job.n_row() * job.n_unit() / (4 * n_thread) + 1, kTile);
    job.block_rows = min(fair, kRows);
    return ceil_div(job.n_row(), job.block_rows) * job.n_unit();
  }

  static void run(const AttentionJob& job, std::int64_t item) {
    [[maybe_unused]] typename P::Session session;
    const std::int64_t n_block = ceil_div(job.n_row(), job.block_rows), row = item % n_block * job.block_rows;
    Block(job, item / n_block, row, static_cast<int>(min(job.n_row() - row, job.block_rows))).run();
  }

  /// A block: at most kRows rows of one unit.
  struct Block {
    const AttentionJob& job;
    const std::int64_t unit, batch;
    const Panels query_panels = Panels(job.d_head, 0);
    const int n_row;
    const int n_tiled = static_cast<int>(round_up(n_row, kTile));
    std::int64_t head[kRows], query[kRows];  // each row's head and query
    typename P::Work work;
    alignas(64) float mixed[kRows * kHeadStride];
    // State of one pass, or of two if the next pass's products are computed together with this pass's weights.
    static constexpr int kBuffers = P::kBeside ? 2 : 1, kBufferSize = kPart * kKeyStride;
    // Scores, later weights in the same place. Rows without a query have arbitrary values; their products go to rows
    // that are not read.
    alignas(64) float score[kBuffers * kBufferSize];
    alignas(64) Number query_number[kRows * kHeadStride];
    static constexpr int kRowVectors = round_up(kRows, kWidth);  // padded to whole vectors
    alignas(64) float sum[kRowVectors * kWidth];                 // sum of a row's weights, lane by lane
    // One value per row; weights are relative to the score `base`.
    alignas(64) float base[kRowVectors], minus_offset[kRowVectors], shrink[kRowVectors];

    VLA_INLINE Block(const AttentionJob& j, std::int64_t i, std::int64_t first_row, int n)
        : job(j), unit(i), batch(unit / job.n_head_kv), n_row(n) {
      std::int64_t h = unit % job.n_head_kv * (job.n_head / job.n_head_kv) + first_row / job.n_query;
      std::int64_t q = first_row % job.n_query;
      for (int r = 0; r < n_row; ++r) {
        head[r] = h, query[r] = q;
        if (++q == job.n_query) q = 0, ++h;
      }
    }

    enum class Seen { none, some, all };
    /// A pass: some rows of the block with one chunk, n keys of a segment starting at `key`.
    struct Pass {
      int segment = 0;
      std::int64_t key = 0;
      int n = 0;
      Seen seen = Seen::none;
      bool sum = false;                    // adds to earlier chunks' output
      int first = 0, end = 0, buffer = 0;  // rows first to end - 1, and the index of the buffer with their scores
    };
    float* scores(const Pass& pass, int row) {
      return score + pass.buffer * kBufferSize + (row - pass.first) * kKeyStride;
    }
    static constexpr int kWeightStride = kKeyStride * static_cast<int>(sizeof(float) / sizeof(Number));
    Number* weights(const Pass& pass, int row) { return reinterpret_cast<Number*>(scores(pass, row)); }

    void run() {
      start();
      Pass before, now = pass_from(0, 0);
      if (now.n == 0) std::memset(mixed, 0, sizeof(mixed));  // the rows see no key at all and become NaN
      multiply_keys(now);
      work.finish();
      while (now.n > 0) {
        const Pass next = pass_behind(now);
        if constexpr (P::kBeside) mix_values(before), multiply_keys(next);
        weigh(now);
        work.finish();
        shrink_rows(now);
        if constexpr (!P::kBeside) mix_values(now), multiply_keys(next);
        before = now, now = next;
      }
      if constexpr (P::kBeside) mix_values(before), work.finish();
      finish();
    }

    void start() {
      for (int r = 0; r < n_tiled; ++r)
        if (Number* to = query_number + r * kHeadStride; r < n_row)
          query_panels.copy_row(job.q, head[r], query[r], batch, job.prep, query_panels.key_depth, to);
        else
          query_panels.copy_nothing(query_panels.key_depth, to);
      for (int r = 0; r < kRowVectors; ++r) V::store(sum + r * kWidth, Float{});
      for (int r = 0; r < kRowVectors; r += kWidth) V::store(base + r, V::set(kNever));
    }

    /// Returns the first pass of the next chunk at or after `key` in which the block's queries see a key. The pass has
    /// n = 0 if there is no such chunk.
    Pass pass_from(int i_segment, std::int64_t key) const {
      for (; i_segment < job.n_segment; ++i_segment, key = 0) {
        const AttentionJob::Segment& segment = job.segment[i_segment];
        for (; key < segment.n_key; key += kKeys) {
          const int n = static_cast<int>(min(segment.n_key - key, kKeys));
          const Seen seen = job.mask == nullptr ? Seen::all : look(segment.first + key, n);
          if (seen != Seen::none)
            return {.segment = i_segment, .key = key, .n = n, .seen = seen, .end = n_row < kPart ? n_row : kPart};
        }
      }
      return {};
    }

    Pass pass_behind(const Pass& pass) const {
      Pass next = pass;
      if (pass.end < n_row) {
        next.first = pass.end;
        next.end = n_row - pass.end < kPart ? n_row : pass.end + kPart;
      } else {
        next = pass_from(pass.segment, pass.key + kKeys);
        next.sum = true;
      }
      next.buffer = kBuffers - 1 - pass.buffer;
      return next;
    }

    /// Whether the block's queries see all, some or none of a chunk's keys.
    Seen look(std::int64_t key, int n) const {
      bool none = true, all = true;
      for (int r = 0; r < n_row && (none || all); ++r) {
        const float* mask = job.mask + query[r] * job.n_key + key;
        Float max_seen = V::set(mask[0]), min_seen = V::set(-mask[0]);
        int j = 0;
        for (; j + kWidth <= n; j += kWidth) {
          max_seen = V::max(max_seen, V::load(mask + j));
          min_seen = V::max(min_seen, -V::load(mask + j));
        }
        float top = V::max(max_seen), bottom = -V::max(min_seen);
        for (; j < n; ++j) top = mask[j] > top ? mask[j] : top, bottom = mask[j] < bottom ? mask[j] : bottom;
        none = none && top == kNever;
        all = all && top == 0.0f && bottom == 0.0f;
      }
      return all ? Seen::all : none ? Seen::none : Seen::some;
    }

    Panels panels_of(const Pass& pass) const { return Panels(job.d_head, job.segment[pass.segment].n_key); }
    const Number* packed(const Pass& pass) const {
      return reinterpret_cast<const Number*>(job.segment[pass.segment].packed);
    }

    void multiply_keys(const Pass& pass) {
      if (pass.n == 0) return;
      const Panels panels = panels_of(pass);
      const Number* keys = packed(pass) + panels.keys(unit);
      const std::int64_t depth = panels.key_depth;
      for (int j = 0; j < pass.n; j += kPanel)
        for (int r = pass.first; r < pass.end; r += kTile)
          work.template add<kHeadStride, kKeyStride>(query_number + r * kHeadStride, keys + (pass.key + j) * depth,
                                                     depth, kPanel, scores(pass, r) + j, false);
    }

    /// Turns scores into weights, with steps of queued products between the rows.
    void weigh(const Pass& pass) {
      if (pass.n % kPanel != 0 || pass.seen == Seen::some) hide(pass);
      const float factor = pass.seen == Seen::some ? P::kLogOfE : job.scale * P::kLogOfE;
      const int n = pass.end - pass.first, n_step = (work.n_step() + n - 1) / n;
      for (int r = pass.first; r < pass.end; r += kWidth) weigh_rows(r, pass, factor, n_step);
    }

    /// Applies the mask, and hides padding keys.
    void hide(const Pass& pass) {
      const int last = pass.n / kPanel * kPanel;  // padding of the last panel
      float missing[kPanel] = {};
      for (int j = pass.n - last; j < kPanel; ++j) missing[j] = kNever;
      for (int r = pass.first; r < pass.end; ++r) {
        float* row = scores(pass, r);
        for (int j = 0; last < pass.n && j < kPanel; j += kWidth)
          V::store(row + last + j, V::load(row + last + j) + V::load(missing + j));
        if (pass.seen == Seen::all) continue;
        const float* mask = job.mask + query[r] * job.n_key + job.segment[pass.segment].first + pass.key;
        for (int j = 0; j < pass.n; j += kWidth)
          V::store(row + j, V::fma(V::load(row + j), V::set(job.scale), load<V>(mask + j, pass.n - j)));
      }
    }

    /// Turns the scores of at most kWidth rows, starting at `first`, into weights. Scores times `factor` are the
    /// logarithms of weights, relative to the largest score so far or to one nearly as large.
    VLA_INLINE void weigh_rows(int first, const Pass& pass, float factor, int n_step) {
      const int end = pass.end - first < kWidth ? pass.end : first + kWidth;
      Float tops[kWidth] = {};
      for (int r = first; r < end; ++r) tops[r - first] = greatest(scores(pass, r), pass.n);
      const Float top = factor * across<V>(tops, [](Float a, Float b) VLA_LAMBDA { return V::max(a, b); });
      const Float before = V::load(base + first), now = top > before + P::kSlack ? top : before;
      // A row that saw no key yet has no largest score. Any finite base keeps its weights at zero.
      const Float offset = now == kNever ? Float{} : now;
      V::store(base + first, now);
      V::store(minus_offset + first, -offset);
      V::store(shrink + first, P::power(before - offset));
      for (int r = first; r < end; ++r) {
        work.advance(n_step);
        weigh_row(scores(pass, r), weights(pass, r), pass.n, factor, r);
      }
    }

    static VLA_INLINE Float greatest(const float* row, int n) {
      Float even = V::load(row), odd = V::load(row + kWidth);
      for (int j = 2 * kWidth; j < n; j += 2 * kWidth) {
        even = V::max(even, V::load(row + j));
        odd = V::max(odd, V::load(row + j + kWidth));
      }
      return V::max(even, odd);
    }

    VLA_INLINE void weigh_row(const float* row, Number* weight, int n, float scale, int r) {
      const Float factor = V::set(scale), offset = V::set(minus_offset[r]);
      Float even = V::load(sum + r * kWidth) * shrink[r], odd = {};
      for (int j = 0; j < round_up(n, kPanel); j += 2 * kWidth) {
        const Float a = P::power(V::fma(V::load(row + j), factor, offset));
        const Float b = P::power(V::fma(V::load(row + j + kWidth), factor, offset));
        P::store(weight + j, a, b);
        even += a;
        odd += b;
      }
      V::store(sum + r * kWidth, even + odd);
    }

    /// Rescales the output so far to the new largest scores.
    void shrink_rows(const Pass& pass) {
      for (int r = pass.first; pass.sum && r < pass.end; ++r) {
        if (shrink[r] == 1.0f) continue;
        float* row = mixed + r * kHeadStride;
        for (std::int64_t i = 0; i < query_panels.d_value; i += kWidth) V::store(row + i, V::load(row + i) * shrink[r]);
      }
    }

    void mix_values(const Pass& pass) {
      if (pass.n == 0) return;
      const Panels panels = panels_of(pass);
      const Number* values = packed(pass) + panels.values(unit);
      for (std::int64_t i = 0; i < panels.d_value; i += kPanel) {
        const std::int64_t width = panels.width(i);
        const Number* panel = values + i * panels.n_key + pass.key * width;
        for (int r = pass.first; r < pass.end; r += kTile)
          work.template add<kWeightStride, kHeadStride>(weights(pass, r), panel, round_up(pass.n, P::kDepth), width,
                                                        mixed + r * kHeadStride + i, pass.sum);
      }
    }

    void finish() {
      for (int first = 0; first < n_row; first += kWidth) {
        Float sums[kWidth];
        for (int i = 0; i < kWidth; ++i) sums[i] = V::load(sum + (first + i) * kWidth);
        const Float total = across<V>(sums, [](Float a, Float b) VLA_LAMBDA { return a + b; });
        V::store(shrink + first, 1.0f / total);
      }
      for (int r = 0; r < n_row; ++r) {
        const float* row = mixed + r * kHeadStride;
        const std::int64_t out_row = batch * job.n_query + query[r], column = head[r] * job.d_head;
        if constexpr (P::kRounded != RoundedLayout::none)
          if (job.out_layout == P::kRounded) {
            write_rounded(row, shrink[r], out_row, column);
            continue;
          }
        float* out = reinterpret_cast<float*>(job.out) + out_row * job.n_head * job.d_head + column;
        for (std::int64_t i = 0; i < job.d_head; i += kWidth)
          store<V>(out + i, V::load(row + i) * shrink[r], job.d_head - i);
      }
    }

    /// Writes the elements of one head to a row, starting at a column.
    void write_rounded(const float* from, float factor, std::int64_t row, std::int64_t column) const {
      alignas(64) Number room[kHeadStride];
      for (std::int64_t i = 0; i < job.d_head; i += 2 * kWidth)
        P::store(room + i, V::load(from + i) * factor, V::load(from + i + kWidth) * factor);
      auto* out = reinterpret_cast<Number*>(job.out);
      for_pieces(P::kRounded, row, column, job.d_head, job.n_head * job.d_head,
                 [&](std::int64_t i, std::int64_t place, std::int64_t n)
                     VLA_LAMBDA { std::memcpy(out + place, room + i, static_cast<std::size_t>(n) * sizeof(*room)); });
    }
  };
};

}  // namespace vla::kernels
