// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/attention.h"

#include "cuda/kernels/device.h"

namespace vla::cuda {
namespace {

constexpr float kLog2 = 1.4426950408889634f;
constexpr float kMinusInfinity = -__builtin_huge_valf();

/// The work of block y: one head of keys and values in one batch.
struct Unit {
  int head_kv, batch;
  VLA_DEVICE explicit Unit(const AttentionJob& job)
      : head_kv(static_cast<int>(blockIdx.y) % job.n_head_kv), batch(static_cast<int>(blockIdx.y) / job.n_head_kv) {}
};
template <class T>
VLA_DEVICE const T* row_of(const HeadRows& rows, int head, int token, int batch) {
  return static_cast<const T*>(rows.data) + head * rows.head + token * rows.token + batch * rows.batch;
}
/// Row r of a unit's queries: the unit's heads for one query, then for the next.
VLA_DEVICE int query_of(const AttentionJob& job, int row) { return row / job.group(); }
VLA_DEVICE int head_of(const AttentionJob& job, const Unit& unit, int row) {
  return unit.head_kv * job.group() + row % job.group();
}

/// Iterates over tiles of keys; a tile belongs to one segment. With a split, blocks take tiles in turn.
template <int kKeys>
struct Tiles {
  const AttentionJob& job;
  // the tile's segment, its first key in it, number of keys in earlier segments
  int segment = 0, first = 0, before = 0, number = 0;

  VLA_DEVICE explicit Tiles(const AttentionJob& of) : job(of) {
    skip_ends();
    while (more() && number % job.n_split != static_cast<int>(blockIdx.z)) step();
  }
  VLA_DEVICE bool more() const { return segment < job.n_segment; }
  VLA_DEVICE void next() {
    for (int i = 0; i < job.n_split && more(); ++i) step();
  }
  VLA_DEVICE int n_key() const {
    return job.segment[segment].n_key - first < kKeys ? job.segment[segment].n_key - first : kKeys;
  }

 private:
  VLA_DEVICE void step() {
    first += kKeys, ++number;
    skip_ends();
  }
  VLA_DEVICE void skip_ends() {
    while (more() && first >= job.segment[segment].n_key) before += job.segment[segment].n_key, first = 0, ++segment;
  }
};
VLA_DEVICE int count_keys(const AttentionJob& job) {
  int n = 0;
  for (int i = 0; i < job.n_segment; ++i) n += job.segment[i].n_key;
  return n;
}

/// The base that is subtracted from scores: the largest score, or any finite value for a row without keys, so that its
/// weights are zero.
VLA_DEVICE float finite(float most) { return most == kMinusInfinity ? 0 : most; }
/// The factor that rescales the sums when the largest score grows.
VLA_DEVICE float shrink(float before, float after) { return dev::power_of_two(before - finite(after)); }
VLA_DEVICE float weight_of(float score, float most) { return dev::power_of_two(score - finite(most)); }

VLA_DEVICE float* partial_row(const AttentionJob& job, int row, int split) {
  const std::int64_t unit = static_cast<std::int64_t>(split) * job.n_head_kv * job.n_batch + blockIdx.y;
  return job.partial + (unit * job.n_row() + row) * (job.d_head + 2);
}
VLA_DEVICE void store_y(const AttentionJob& job, const Unit& unit, int row, int i, float value) {
  const std::int64_t at = ((static_cast<std::int64_t>(unit.batch) * job.n_query + query_of(job, row)) * job.n_head +
                           head_of(job, unit, row)) *
                              job.d_head +
                          i;
  store(job.y, job.is_bf16, at, value);
}

// Tensor cores: a warp has 16 rows, a block 64

constexpr int kRows = 64, kThreads = 128;

template <int kDepth_>
struct Shape {
  static constexpr int kDepth = kDepth_, kKeys = kDepth == 256 ? 32 : 64;
  static constexpr int kSteps = kDepth / 16, kTiles = kDepth / 8;
  /// Rows are padded by 16 bytes, so that the eight rows of a matrix load are in different banks.
  static constexpr int kRow = kDepth * 2 + 16, kTile = kKeys * kRow;
  static constexpr bool kKeepsQ = kDepth <= 128;  // queries in registers
};

/// Copies rows to shared memory, padded with zeros after the last row and after d_head.
template <class S, class RowOf>
VLA_DEVICE void fetch_rows(std::byte* to, int n, int n_valid, int d_head, const void* somewhere, RowOf row_at) {
  constexpr int kChunks = S::kDepth / 8;
  for (int chunk = thread_index(); chunk < n * kChunks; chunk += kThreads) {
    const int row = chunk / kChunks, i = chunk % kChunks * 8;
    const bool valid = row < n_valid && i < d_head;
    dev::copy_async(to + row * S::kRow + i * 2, valid ? row_at(row) + i : somewhere, valid ? 16 : 0);
  }
}
template <class S>
VLA_DEVICE void fetch_keys(const AttentionJob& job, const Unit& unit, const Tiles<S::kKeys>& tile, std::byte* to) {
  const AttentionJob::Segment& segment = job.segment[tile.segment];
  const auto rows = [&](const HeadRows& of) {
    return [&](int row) { return row_of<std::uint16_t>(of, unit.head_kv, tile.first + row, unit.batch); };
  };
  fetch_rows<S>(to, S::kKeys, tile.n_key(), job.d_head, segment.k.data, rows(segment.k));
  fetch_rows<S>(to + S::kTile, S::kKeys, tile.n_key(), job.d_head, segment.v.data, rows(segment.v));
}

/// Scores of one tile for a warp's rows, scaled for exponentials of base 2.
template <class S>
VLA_DEVICE void score(const std::byte* q_rows, const unsigned (&q)[S::kSteps][4], const std::byte* k,
                      float (&scores)[S::kKeys / 8][4]) {
  const int lane = thread_index() % kLanes;
#pragma unroll
  for (int i = 0; i < S::kSteps; ++i) {
    unsigned a[4] = {q[i][0], q[i][1], q[i][2], q[i][3]};
    if constexpr (!S::kKeepsQ) dev::load_matrices(a, q_rows + (2 * i + lane / 16) * 16);
#pragma unroll
    for (int n = 0; n < S::kKeys / 16; ++n) {
      unsigned b[4];
      dev::load_matrices(b, k + (n * 16 + lane / 16 * 8 + lane % 8) * S::kRow + (2 * i + lane / 8 % 2) * 16);
      dev::multiply_bf16(scores[2 * n], a, b[0], b[1]);
      dev::multiply_bf16(scores[2 * n + 1], a, b[2], b[3]);
    }
  }
}

template <class S>
VLA_DEVICE void attend_bf16(const AttentionJob& job) {
  std::byte *shared = dev::shared_memory(), *stages = shared + kRows * S::kRow;
  const int lane = thread_index() % kLanes, warp_row = thread_index() / kLanes * 16;
  const int row0 = static_cast<int>(blockIdx.x) * kRows, n_key = count_keys(job);
  const Unit unit(job);
  Tiles<S::kKeys> tile(job), ahead(job);

  fetch_rows<S>(shared, kRows, job.n_row() - row0, job.d_head, job.q.data, [&](int row) {
    return row_of<std::uint16_t>(job.q, head_of(job, unit, row0 + row), query_of(job, row0 + row), unit.batch);
  });
  if (ahead.more()) fetch_keys<S>(job, unit, ahead, stages);
  dev::commit_copies();

  // A lane's sums 0 and 1 belong to row lane / 4, sums 2 and 3 to row lane / 4 + 8.
  const float* mask[2] = {};
#pragma unroll
  for (int h = 0; h < 2; ++h) {
    const int row = row0 + warp_row + lane / 4 + h * 8;
    if (job.mask) mask[h] = job.mask + static_cast<std::int64_t>(query_of(job, row < job.n_row() ? row : 0)) * n_key;
  }
  const float scale = job.scale * kLog2;
  const std::byte* q_rows = shared + (warp_row + lane % 16) * S::kRow;
  unsigned q[S::kSteps][4] = {};
  float y[S::kTiles][4] = {}, most[2] = {kMinusInfinity, kMinusInfinity}, total[2] = {};
  for (int stage = 0; tile.more(); stage ^= 1, tile.next()) {
    ahead.next();
    if (ahead.more()) fetch_keys<S>(job, unit, ahead, stages + (stage ^ 1) * 2 * S::kTile);
    dev::commit_copies();
    dev::wait_copies<1>();
    __syncthreads();  // the tile is visible to all threads
    const std::byte *k = stages + stage * 2 * S::kTile, *v = k + S::kTile;
    if (S::kKeepsQ && tile.number < job.n_split) {
#pragma unroll
      for (int i = 0; i < S::kSteps; ++i) dev::load_matrices(q[i], q_rows + (2 * i + lane / 16) * 16);
    }

    float scores[S::kKeys / 8][4] = {};
    score<S>(q_rows, q, k, scores);
    const int n_valid = tile.n_key(), first_key = tile.before + tile.first;
    const auto each = [&](auto change) {  // score, row (0 or 8 below), key in the tile
#pragma unroll
      for (int n = 0; n < S::kKeys / 8; ++n)
#pragma unroll
        for (int c = 0; c < 4; ++c) change(scores[n][c], c / 2, n * 8 + lane % 4 * 2 + c % 2);
    };
    each([&](float& one, int, int) { one *= scale; });
    if (job.mask)
      each([&](float& one, int h, int key) { one += mask[h][first_key + (key < n_valid ? key : 0)] * kLog2; });
    if (n_valid < S::kKeys) each([&](float& one, int, int key) { one = key < n_valid ? one : kMinusInfinity; });
    float tile_most[2] = {most[0], most[1]};
    each([&](float& one, int h, int) { tile_most[h] = fmaxf(tile_most[h], one); });
#pragma unroll
    for (int h = 0; h < 2; ++h) {
      tile_most[h] = fmaxf(tile_most[h], dev::shuffle_xor(tile_most[h], 1));
      tile_most[h] = fmaxf(tile_most[h], dev::shuffle_xor(tile_most[h], 2));
      const float factor = shrink(most[h], tile_most[h]);
      most[h] = tile_most[h], total[h] *= factor;
#pragma unroll
      for (int n = 0; n < S::kTiles; ++n) y[n][2 * h] *= factor, y[n][2 * h + 1] *= factor;
    }
    const float base[2] = {finite(most[0]), finite(most[1])};
    unsigned weights[S::kKeys / 16][4];  // in the register order of operand a
#pragma unroll
    for (int n = 0; n < S::kKeys / 8; ++n)
#pragma unroll
      for (int h = 0; h < 2; ++h) {
        const float low = dev::power_of_two(scores[n][2 * h] - base[h]),
                    high = dev::power_of_two(scores[n][2 * h + 1] - base[h]);
        total[h] += low + high;
        weights[n / 2][n % 2 * 2 + h] = dev::to_bf16(low, high);
      }
#pragma unroll
    for (int i = 0; i < S::kKeys / 16; ++i)
#pragma unroll
      for (int n = 0; n < S::kTiles; n += 2) {
        unsigned b[4];
        dev::load_transposed(b, v + (i * 16 + lane % 16) * S::kRow + (n + lane / 16) * 16);
        dev::multiply_bf16(y[n], weights[i], b[0], b[1]);
        dev::multiply_bf16(y[n + 1], weights[i], b[2], b[3]);
      }
    __syncthreads();  // all threads have read the stage that is overwritten next
  }
  dev::wait_copies<0>();

#pragma unroll
  for (int h = 0; h < 2; ++h) {
    total[h] += dev::shuffle_xor(total[h], 1);
    total[h] += dev::shuffle_xor(total[h], 2);
    const int row = row0 + warp_row + lane / 4 + h * 8;
    if (row >= job.n_row()) continue;
    float* partial = job.n_split > 1 ? partial_row(job, row, static_cast<int>(blockIdx.z)) : nullptr;
    if (partial && lane % 4 == 0) partial[job.d_head] = most[h], partial[job.d_head + 1] = total[h];
#pragma unroll
    for (int n = 0; n < S::kTiles; ++n)
#pragma unroll
      for (int c = 0; c < 2; ++c) {
        const int i = n * 8 + lane % 4 * 2 + c;
        if (i >= job.d_head) continue;
        if (partial)
          partial[i] = y[n][2 * h + c];
        else
          store_y(job, unit, row, i, y[n][2 * h + c] / total[h]);
      }
  }
}

}  // namespace

using Shape64 = Shape<64>;
using Shape80 = Shape<80>;
using Shape128 = Shape<128>;
using Shape256 = Shape<256>;

VLA_KERNEL(attention_bf16_64, 128, 2, AttentionJob) { attend_bf16<Shape64>(job); }
VLA_KERNEL(attention_bf16_80, 128, 1, AttentionJob) { attend_bf16<Shape80>(job); }
VLA_KERNEL(attention_bf16_128, 128, 1, AttentionJob) { attend_bf16<Shape128>(job); }
VLA_KERNEL(attention_bf16_256, 128, 1, AttentionJob) { attend_bf16<Shape256>(job); }

/// A warp computes one row, a block eight. A lane has one key while scores are computed, then every 32nd element of y.
VLA_KERNEL(attention_f32, 256, 2, AttentionJob) {
  constexpr int kKeys = 32, kPerLane = kMaxHead / kLanes;
  const int lane = thread_index() % kLanes, warp = thread_index() / kLanes;
  const int row = static_cast<int>(blockIdx.x) * 8 + warp, n_key = count_keys(job), d = job.d_head;
  // row stride in shared memory: lanes that read a column are in different banks
  const int width = (d + 31) / 32 * 32 + 1;
  std::byte *k = dev::shared_memory(), *v = k + kKeys * width * 4, *q = v + (kKeys + warp) * width * 4;
  const Unit unit(job);
  const bool valid = row < job.n_row();
  const float* from_q =
      row_of<float>(job.q, head_of(job, unit, valid ? row : 0), query_of(job, valid ? row : 0), unit.batch);
  for (int i = lane; i < d; i += kLanes) dev::write(q + i * 4, from_q[i]);

  float y[kPerLane] = {}, most = kMinusInfinity, total = 0;
  for (Tiles<kKeys> tile(job); tile.more(); tile.next()) {
    const AttentionJob::Segment& segment = job.segment[tile.segment];
    __syncthreads();  // all threads have read the previous tile
    for (int key = warp; key < tile.n_key(); key += 8) {
      const float* from_k = row_of<float>(segment.k, unit.head_kv, tile.first + key, unit.batch);
      const float* from_v = row_of<float>(segment.v, unit.head_kv, tile.first + key, unit.batch);
      for (int i = lane; i < d; i += kLanes) {
        dev::write(k + (key * width + i) * 4, from_k[i]);
        dev::write(v + (key * width + i) * 4, from_v[i]);
      }
    }
    __syncthreads();
    float one = kMinusInfinity;
    if (lane < tile.n_key()) {
      float dot = 0;
      for (int i = 0; i < d; ++i) dot += dev::read<float>(q + i * 4) * dev::read<float>(k + (lane * width + i) * 4);
      one = dot * (job.scale * kLog2);
      if (job.mask && valid)
        one +=
            job.mask[static_cast<std::int64_t>(query_of(job, row)) * n_key + tile.before + tile.first + lane] * kLog2;
    }
    float after = fmaxf(most, one);
    for (int mask = 16; mask > 0; mask /= 2) after = fmaxf(after, dev::shuffle_xor(after, mask));
    const float factor = shrink(most, after), weight = weight_of(one, after);
    most = after, total = total * factor + sum_of_warp(weight);
#pragma unroll
    for (int j = 0; j < kPerLane; ++j) y[j] *= factor;
    for (int key = 0; key < tile.n_key(); ++key) {
      const float of_key = dev::shuffle(weight, key);
#pragma unroll
      for (int j = 0; j < kPerLane; ++j)
        if (lane + j * kLanes < d) y[j] += of_key * dev::read<float>(v + (key * width + lane + j * kLanes) * 4);
    }
  }
  if (!valid) return;
  float* partial = job.n_split > 1 ? partial_row(job, row, static_cast<int>(blockIdx.z)) : nullptr;
  if (partial && lane == 0) partial[d] = most, partial[d + 1] = total;
#pragma unroll
  for (int j = 0; j < kPerLane; ++j) {
    const int i = lane + j * kLanes;
    if (i >= d) continue;
    if (partial)
      partial[i] = y[j];
    else
      store_y(job, unit, row, i, y[j] / total);
  }
}

/// Combines the partial sums of a split; a warp computes one row.
VLA_KERNEL(attention_finish, 128, 4, AttentionJob) {
  const int lane = thread_index() % kLanes, row = static_cast<int>(blockIdx.x) * 4 + thread_index() / kLanes;
  const Unit unit(job);
  if (row >= job.n_row()) return;
  float most = kMinusInfinity, total = 0;
  for (int z = 0; z < job.n_split; ++z) most = fmaxf(most, partial_row(job, row, z)[job.d_head]);
  for (int z = 0; z < job.n_split; ++z) {
    const float* partial = partial_row(job, row, z);
    total += partial[job.d_head + 1] * weight_of(partial[job.d_head], most);
  }
  for (int i = lane; i < job.d_head; i += kLanes) {
    float sum = 0;
    for (int z = 0; z < job.n_split; ++z) {
      const float* partial = partial_row(job, row, z);
      sum += partial[i] * weight_of(partial[job.d_head], most);
    }
    store_y(job, unit, row, i, sum / total);
  }
}

}  // namespace vla::cuda
