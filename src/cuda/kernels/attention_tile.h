// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/kernels/attention_rows.h"

/// Shared by the attention kernels on tensor cores: how a block copies keys and values, and what its warps compute.
namespace vla::cuda {

/// The block's share of the keys of all segments, in multiples of 16: keys `first` to last - 1.
struct KeyShare {
  int n_key, first, last;
  VLA_DEVICE explicit KeyShare(const AttentionJob& job) : n_key(count_keys(job)) {
    const int each = (n_key + job.n_split * 16 - 1) / (job.n_split * 16) * 16, z = static_cast<int>(blockIdx.z);
    first = z * each < n_key ? z * each : n_key;
    last = first + each < n_key ? first + each : n_key;
  }
};

template <int kIndex>
struct AttentionBlock {
  static constexpr AttentionShape kOf = kAttentionShapes[kIndex];
  static constexpr int kDepth = kOf.depth, kRows = kOf.rows, kGroups = kOf.key_groups, kKeys = kOf.keys;
  static constexpr int kThreads = kOf.n_thread(), kRowGroups = kRows / 16;
  static constexpr bool kShares = kGroups > 1;  // whether warps share the keys of a tile
  static constexpr bool kTakesMask = true;
  static constexpr int kRow = kOf.row(), kTile = kKeys * kRow, kSumsRow = kOf.sums_row();
  VLA_DEVICE static constexpr int weight_row() { return kKeys * 2 + 16; }
  static constexpr bool kKeepsQ = kDepth <= 128;  // queries in registers
  // Of one warp: its keys of a tile, steps of 16 elements of the depth for a score, tiles of 8 columns of the result,
  // and independent accumulators for scores and for the result.
  static constexpr int kOwnKeys = kKeys / kGroups, kSteps = kDepth / 16, kTiles = kDepth / 8 / kGroups;
  static constexpr int kScoreSums = kOwnKeys >= 32 ? 1 : 2, kSums = kTiles == 1 ? 2 : 1;

  // Threads that copy a row, 16 bytes each: a power of two, so that a thread copies the same column of every row.
  static constexpr int kPerRow = kDepth == 80 ? 16 : kDepth / 8, kRowStep = kThreads / kPerRow;
  /// The first row that this thread copies, and its column.
  VLA_DEVICE static int copied_row() { return thread_index() / kPerRow; }
  VLA_DEVICE static int copied_column() { return thread_index() % kPerRow * 8; }
};

/// Writes zeros to rows `begin` to end - 1, in this thread's columns.
template <class S>
VLA_DEVICE void clear_rows(int begin, int end, std::byte* to) {
  for (int row = S::copied_row(); row < end; row += S::kRowStep)
    if (row >= begin) dev::write(to + row * S::kRow + S::copied_column() * 2, uint4{0, 0, 0, 0});
}
/// Writes zeros to the columns from d_head on, which no copy writes.
template <class S>
VLA_DEVICE void clear_columns(int d_head, int n_row, std::byte* to) {
  if (S::copied_column() >= d_head && S::copied_column() < S::kDepth) clear_rows<S>(0, n_row, to);
}

/// Copies tiles of keys or values to shared memory, from one segment after the other.
template <class S, HeadRows AttentionJob::Segment::*kWhich>
class KeyReader {
 public:
  VLA_DEVICE KeyReader(const AttentionJob& job, const Unit& unit) : job_(job), unit_(unit) { enter(0); }

  /// Copies the rows of keys `first` to last - 1, at most a tile of them, and writes zeros after them.
  VLA_DEVICE void fetch(int first, int last, std::byte* to) {
    const int n = last - first < S::kKeys ? last - first : S::kKeys;
    for (int end = 0; end < n;) {
      while (end_ <= first + end) enter(segment_ + 1);
      const int begin = end;
      end = end_ - first < n ? end_ - first : n;
      copy(begin, end, from_ + (first - begin_) * token_, to);
    }
    if (n < S::kKeys && S::copied_column() < job_.d_head) clear_rows<S>(n, S::kKeys, to);
  }

 private:
  VLA_DEVICE void enter(int segment) {
    const HeadRows& rows = job_.segment[segment].*kWhich;
    segment_ = segment, begin_ = end_, end_ += job_.segment[segment].n_key, token_ = rows.token;
    from_ = row_of<std::uint16_t>(rows, unit_.head_kv, 0, unit_.batch);
  }
  /// Copies rows `begin` to end - 1 of a tile. `from` is the address of row 0, even if the segment has no such row.
  VLA_DEVICE void copy(int begin, int end, const std::uint16_t* from, std::byte* to) const {
    const int row = S::copied_row(), column = S::copied_column();
    if (column >= job_.d_head) return;
    from += row * token_ + column, to += row * S::kRow + column * 2;
#pragma unroll
    for (int i = 0; i < S::kKeys; i += S::kRowStep, from += S::kRowStep * token_)
      if (row + i >= begin && row + i < end) dev::copy_async(to + i * S::kRow, from, 16);
  }

  const AttentionJob& job_;
  const Unit& unit_;
  const std::uint16_t* from_ = nullptr;  // the segment's first row
  std::int64_t token_ = 0;
  int segment_ = 0, begin_ = 0, end_ = 0;
};

/// Copies a block's rows of queries and writes zeros after the last.
template <class S>
VLA_DEVICE void fetch_queries(const AttentionJob& job, const Unit& unit, int row0, std::byte* to) {
  const int column = S::copied_column(), group = job.group();
  const int n = job.n_row() - row0 < S::kRows ? job.n_row() - row0 : S::kRows;
  int query = (row0 + S::copied_row()) / group, head = (row0 + S::copied_row()) % group;
  const int query_step = S::kRowStep / group, head_step = S::kRowStep % group;
  if (column < job.d_head) {
    for (int row = S::copied_row(); row < n; row += S::kRowStep) {
      const int of_group = unit.head_kv * group + head;
      dev::copy_async(to + row * S::kRow + column * 2,
                      row_of<std::uint16_t>(job.q, of_group, query, unit.batch) + column, 16);
      query += query_step, head += head_step;
      if (head >= group) head -= group, ++query;
    }
    clear_rows<S>(n, S::kRows, to);
  }
}

/// A warp's part of a block's work.
/// The warp has 16 rows. Sums 0 and 1 of a lane belong to row lane / 4, sums 2 and 3 to row lane / 4 + 8. These are the
/// halves h = 0 and h = 1 of the rows.
template <class S>
class AttentionWarp {
 public:
  VLA_DEVICE AttentionWarp(const AttentionJob& job, const Unit& unit, int n_key)
      : job_(job), unit_(unit), row0_(static_cast<int>(blockIdx.x) * S::kRows + row_group() * 16) {
    if (!has_mask()) return;
#pragma unroll
    for (int h = 0; h < 2; ++h) {
      const int row = row0_ + lane() / 4 + h * 8;
      mask_[h] = job.mask + static_cast<std::int64_t>(row < job.n_row() ? query_of(job, row) : 0) * n_key;
    }
  }

  VLA_DEVICE static int lane() { return thread_index() % kLanes; }
  VLA_DEVICE static int row_group() { return thread_index() / kLanes % S::kRowGroups; }
  VLA_DEVICE static int key_group() { return thread_index() / kLanes / S::kRowGroups; }

  /// Initializes the scores of the tile that begins at key `first`: mask or 0, and minus infinity from key `last` on.
  VLA_DEVICE void begin_scores(int first, int last) {
    const int key = key_group() * S::kOwnKeys + lane() % 4 * 2, n_key = last - first - key;
    if (!has_mask()) {
      const bool is_whole = last - first >= S::kKeys;
      each_score([&](float& one, int, int at) { one = is_whole || at < n_key ? 0 : kMinusInfinity; });
    } else {
      const float* mask[2] = {mask_[0] + first + key, mask_[1] + first + key};
      each_score([&](float& one, int h, int at) { one = at < n_key ? mask[h][at] : kMinusInfinity; });
    }
  }
  /// Divides the mask by the scale, which scores get later. A separate step gives the mask's loads time to finish.
  VLA_DEVICE void unscale_mask() {
    const float unit = 1 / job_.scale;
    if (has_mask()) each_score([&](float& one, int, int) { one *= unit; });
  }
  VLA_DEVICE void keep_queries(const std::byte* q) {
    if constexpr (S::kKeepsQ)
#pragma unroll
      for (int i = 0; i < S::kSteps; ++i) load_queries(q_[i], q, i);
  }
  /// scores += q k, not scaled yet.
  VLA_DEVICE void score(const std::byte* q, const std::byte* k) {
    float odd[S::kOwnKeys / 8][4] = {};
    k += (key_group() * S::kOwnKeys + lane() / 16 * 8 + lane() % 8) * S::kRow + lane() / 8 % 2 * 16;
#pragma unroll
    for (int i = 0; i < S::kSteps; ++i) {
      unsigned a[4];
      if constexpr (!S::kKeepsQ) load_queries(a, q, i);
      const unsigned(&of_q)[4] = S::kKeepsQ ? q_[S::kKeepsQ ? i : 0] : a;
      auto& sums = S::kScoreSums > 1 && i % 2 ? odd : scores_;
#pragma unroll
      for (int n = 0; n < S::kOwnKeys / 16; ++n) {
        unsigned b[4];
        dev::load_matrices(b, k + n * 16 * S::kRow + i * 32);
        dev::multiply_bf16(sums[2 * n], of_q, b[0], b[1]);
        dev::multiply_bf16(sums[2 * n + 1], of_q, b[2], b[3]);
      }
    }
    if constexpr (S::kScoreSums > 1) add(scores_, odd);
  }
  /// Computes each row's largest score so far, including this warp's keys of the tile.
  VLA_DEVICE void find_most(float (&most)[2]) const {
#pragma unroll
    for (int h = 0; h < 2; ++h) {
      most[h] = most_[h];
#pragma unroll
      for (int n = 0; n < S::kOwnKeys / 8; ++n)
        most[h] = fmaxf(most[h], fmaxf(scores_[n][2 * h], scores_[n][2 * h + 1]));
      most[h] = fmaxf(most[h], dev::shuffle_xor(most[h], 1));
      most[h] = fmaxf(most[h], dev::shuffle_xor(most[h], 2));
    }
  }
  /// Rescales the sums of rows whose largest score grows to `most`.
  VLA_DEVICE void shrink_to(const float (&most)[2]) {
    const float scale = job_.scale * kLog2;
#pragma unroll
    for (int h = 0; h < 2; ++h) {
      const float factor = dev::power_of_two((most_[h] - finite(most[h])) * scale);
      most_[h] = most[h], total_[h] *= factor;
#pragma unroll
      for (int s = 0; s < S::kSums; ++s)
#pragma unroll
        for (int n = 0; n < S::kTiles; ++n) y_[s][n][2 * h] *= factor, y_[s][n][2 * h + 1] *= factor;
    }
  }
  /// Computes the weights of this warp's keys and calls take(tile of 8 keys, half of the rows, two bf16 weights).
  template <class Take>
  VLA_DEVICE void weigh(Take take) {
    const float scale = job_.scale * kLog2;
#pragma unroll
    for (int h = 0; h < 2; ++h) {
      const float base = finite(most_[h]) * scale;
#pragma unroll
      for (int n = 0; n < S::kOwnKeys / 8; ++n) {
        const float low = dev::power_of_two(scores_[n][2 * h] * scale - base),
                    high = dev::power_of_two(scores_[n][2 * h + 1] * scale - base);
        total_[h] += low + high;
        take(n, h, dev::to_bf16(low, high));
      }
    }
  }
  /// y += weights * v, for 16 keys; `v` points to this lane's row of the values.
  VLA_DEVICE void add_values(const unsigned (&weights)[4], const std::byte* v) {
#pragma unroll
    for (int n = 0; n < S::kTiles; n += 2) {
      unsigned b[4];
      dev::load_transposed(b, v + (n + lane() / 16) * 16);
      dev::multiply_bf16(y_[0][n], weights, b[0], b[1]);
      dev::multiply_bf16(y_[0][n + 1], weights, b[2], b[3]);
    }
  }
  /// Adds the tile's values, with weights in registers.
  VLA_DEVICE void add_values_alone(const std::byte* v) {
    unsigned weights[S::kOwnKeys / 16][4];  // in the order of operand a
    weigh([&](int n, int h, unsigned pair) { weights[n / 2][n % 2 * 2 + h] = pair; });
#pragma unroll
    for (int i = 0; i < S::kOwnKeys / 16; ++i) add_values(weights[i], v + (i * 16 + lane() % 16) * S::kRow);
  }

  VLA_DEVICE void write_weights(std::byte* to) {
    to += (row_group() * 16 + lane() / 4) * S::weight_row() + (key_group() * S::kOwnKeys + lane() % 4 * 2) * 2;
    weigh([&](int n, int h, unsigned pair) { dev::write(to + h * 8 * S::weight_row() + n * 16, pair); });
  }
  /// Adds the tile's values in this warp's columns, with all warps' weights. Skips groups of 64 keys after `n_key`.
  VLA_DEVICE void add_values_shared(const std::byte* weights, const std::byte* v, int n_key) {
    weights += (row_group() * 16 + lane() % 16) * S::weight_row() + lane() / 16 * 16;
    v += key_group() * S::kTiles * 16;
    constexpr int kAtOnce = S::kKeys < 64 ? S::kKeys : 64;
#pragma unroll
    for (int first = 0; first < S::kKeys; first += kAtOnce) {
      if (first > 0 && first >= n_key) break;
#pragma unroll
      for (int key = first; key < first + kAtOnce; key += 32) {
        unsigned a[2][4];
        dev::load_matrices(a[0], weights + key * 2);
        dev::load_matrices(a[1], weights + key * 2 + 32);
        if constexpr (S::kTiles == 1) {
          unsigned b[4];
          dev::load_transposed(b, v + (key + lane()) * S::kRow);
          dev::multiply_bf16(y_[0][0], a[0], b[0], b[1]);
          dev::multiply_bf16(y_[S::kSums - 1][0], a[1], b[2], b[3]);
        } else {
          add_values(a[0], v + (key + lane() % 16) * S::kRow);
          add_values(a[1], v + (key + 16 + lane() % 16) * S::kRow);
        }
      }
    }
  }

  /// Combines the values of a row group's warps; every warp gets the result. `room`: a float per row and key group.
  /// All threads of the block must call it, because it has a barrier.
  template <class Combine>
  VLA_DEVICE void across_groups(float (&values)[2], std::byte* room, Combine combine) const {
    room += (row_group() * 16 + lane() / 4) * 4;
    if (lane() % 4 == 0)
      for (int h = 0; h < 2; ++h) dev::write(room + (key_group() * S::kRows + h * 8) * 4, values[h]);
    __syncthreads();  // every warp's values are written
#pragma unroll
    for (int h = 0; h < 2; ++h) {
      values[h] = dev::read<float>(room + h * 32);
#pragma unroll
      for (int g = 1; g < S::kGroups; ++g)
        values[h] = combine(values[h], dev::read<float>(room + (g * S::kRows + h * 8) * 4));
    }
  }
  /// Completes the sums by those of other lanes and warps. If warps share keys, all of them have read the tiles then.
  VLA_DEVICE void complete(std::byte* room) {
    if constexpr (S::kSums > 1) add(y_[0], y_[1]);
#pragma unroll
    for (int h = 0; h < 2; ++h) {
      total_[h] += dev::shuffle_xor(total_[h], 1);
      total_[h] += dev::shuffle_xor(total_[h], 2);
    }
    if constexpr (S::kShares) across_groups(total_, room, [](float a, float b) { return a + b; });
  }
  /// Stores the rows of y, or the sums of a share of the keys: kInCluster to the block's rows of sums in shared memory.
  template <bool kInCluster = false>
  VLA_DEVICE void store_rows(std::byte* sums = nullptr) const {
#pragma unroll
    for (int h = 0; h < 2; ++h) store_row<kInCluster>(row0_ + lane() / 4 + h * 8, h, sums);
  }

 protected:
  const AttentionJob& job_;
  float scores_[S::kOwnKeys / 8][4], y_[S::kSums][S::kTiles][4] = {};
  float most_[2] = {kMinusInfinity, kMinusInfinity}, total_[2] = {};

 private:
  VLA_DEVICE bool has_mask() const { return S::kTakesMask && job_.mask != nullptr; }
  /// Calls change(score, half of the rows, key minus the lane's first key) for each score.
  template <class Change>
  VLA_DEVICE void each_score(Change change) {
#pragma unroll
    for (int n = 0; n < S::kOwnKeys / 8; ++n)
#pragma unroll
      for (int c = 0; c < 4; ++c) change(scores_[n][c], c / 2, n * 8 + c % 2);
  }
  VLA_DEVICE static void load_queries(unsigned (&a)[4], const std::byte* q, int step) {
    dev::load_matrices(a, q + (row_group() * 16 + lane() % 16) * S::kRow + (2 * step + lane() / 16) * 16);
  }
  template <int n>
  VLA_DEVICE static void add(float (&to)[n][4], const float (&from)[n][4]) {
#pragma unroll
    for (int i = 0; i < n; ++i)
#pragma unroll
      for (int c = 0; c < 4; ++c) to[i][c] += from[i][c];
  }
  /// Lanes of a warp write to different banks.
  VLA_DEVICE void place_row(std::byte* sums, int column, int h) const {
    if (lane() % 4 == 0 && key_group() == 0)
      dev::write(sums + S::kDepth * 4, float2{most_[h] * (job_.scale * kLog2), total_[h]});
#pragma unroll
    for (int n = 0; n < S::kTiles; ++n)
      dev::write(sums + (column + n * 8) * 4, float2{y_[0][n][2 * h], y_[0][n][2 * h + 1]});
  }
  template <bool kInCluster>
  VLA_DEVICE void store_row(int row, int h, std::byte* sums) const {
    if (row >= job_.n_row()) return;
    const int column = key_group() * S::kTiles * 8 + lane() % 4 * 2;
    if constexpr (kInCluster)
      return place_row(sums + (row - static_cast<int>(blockIdx.x) * S::kRows) * S::kSumsRow, column, h);
    if (job_.n_split > 1) {
      float* partial = partial_row(job_, row, static_cast<int>(blockIdx.z));
      if (lane() % 4 == 0 && key_group() == 0)
        partial[job_.d_head] = most_[h] * (job_.scale * kLog2), partial[job_.d_head + 1] = total_[h];
#pragma unroll
      for (int n = 0; n < S::kTiles; ++n)
        if (column + n * 8 < job_.d_head)
          store_pair(partial, false, column + n * 8, y_[0][n][2 * h], y_[0][n][2 * h + 1]);
      return;
    }
    const std::int64_t at = y_row(job_, unit_, row);
    const float share = 1 / total_[h];
#pragma unroll
    for (int n = 0; n < S::kTiles; ++n)
      if (column + n * 8 < job_.d_head)
        store_pair(job_.y, job_.is_bf16, at + column + n * 8, y_[0][n][2 * h] * share, y_[0][n][2 * h + 1] * share);
  }

  const Unit& unit_;
  int row0_;
  const float* mask_[2] = {};  // the mask's rows for the lane's two rows
  unsigned q_[S::kKeepsQ ? S::kSteps : 1][4] = {};
};

/// Warps divide a tile's keys among them, then the columns of the result. The next tile's keys are copied while values
/// are multiplied, and a tile's values while its scores are computed. Calls end(warp) once the sums are complete and
/// nothing reads queries, keys and values any more.
template <class S, class End>
VLA_DEVICE void attend_shared(const AttentionJob& job, const Unit& unit, End end) {
  std::byte *q = dev::shared_memory(), *k = q + S::kRows * S::kRow, *v = k + S::kTile;
  std::byte *weights = v + S::kTile, *room = weights + S::kRows * S::weight_row();
  const KeyShare share(job);
  KeyReader<S, &AttentionJob::Segment::k> keys(job, unit);
  KeyReader<S, &AttentionJob::Segment::v> values(job, unit);
  dev::wait_for_earlier();
  clear_columns<S>(job.d_head, S::kRows + 2 * S::kKeys, q);
  fetch_queries<S>(job, unit, static_cast<int>(blockIdx.x) * S::kRows, q);
  if (share.first < share.last) keys.fetch(share.first, share.last, k);
  dev::commit_copies();
  if (share.first < share.last) values.fetch(share.first, share.last, v);
  dev::commit_copies();

  AttentionWarp<S> warp(job, unit, share.n_key);
  for (int first = share.first; first < share.last; first += S::kKeys) {
    const bool is_first = first == share.first;
    warp.begin_scores(first, share.last);
    if (is_first)
      dev::wait_copies<1>();
    else
      dev::wait_copies<0>();
    __syncthreads();  // keys are visible to all threads, and all have read the previous tile's values
    if (!is_first) {
      values.fetch(first, share.last, v);
      dev::commit_copies();
    } else {
      warp.keep_queries(q);
    }
    warp.unscale_mask();
    warp.score(q, k);
    float most[2];
    warp.find_most(most);
    warp.across_groups(most, room, [](float a, float b) { return fmaxf(a, b); });
    if (first + S::kKeys < share.last) keys.fetch(first + S::kKeys, share.last, k);  // after a barrier: all have read k
    dev::commit_copies();
    warp.shrink_to(most);
    warp.write_weights(weights);
    dev::wait_copies<1>();
    __syncthreads();  // values and weights are visible to all threads
    warp.add_values_shared(weights, v, share.last - first);
  }
  dev::let_next_begin();
  dev::wait_copies<0>();
  warp.complete(room);
  end(warp);
}

}  // namespace vla::cuda
