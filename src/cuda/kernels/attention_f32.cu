// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/attention_rows.h"

namespace vla::cuda {
namespace {

/// The factor that rescales the sums when the largest score grows.
VLA_DEVICE float shrink(float before, float after) { return dev::power_of_two(before - finite(after)); }
VLA_DEVICE void store_y(const AttentionJob& job, const Unit& unit, int row, int i, float value) {
  store(job.y, job.is_bf16, y_row(job, unit, row) + i, value);
}

/// Iterates over tiles of keys; a tile belongs to one segment. With a split, blocks take tiles in turn.
template <int kKeys>
struct Tiles {
  const AttentionJob& job;
  // the tile's segment, its first key within the segment, the keys in earlier segments, the tile's index
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

}  // namespace

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

/// Combines the partial sums of a split; a warp computes 64 elements of a row. Lane z weighs share z.
VLA_KERNEL(attention_finish, 128, 4, AttentionJob) {
  constexpr int kAtOnce = 16;  // shares whose loads are in flight at a time
  const int lane = thread_index() % kLanes, n_part = (job.d_head + 63) / 64;
  const int warp = static_cast<int>(blockIdx.x) * 4 + thread_index() / kLanes, row = warp / n_part;
  const Unit unit(job);
  if (row >= job.n_row()) return;
  const int i = warp % n_part * 64 + lane;
  const std::int64_t stride = partial_row(job, row, 1) - partial_row(job, row, 0);
  const float* partial = partial_row(job, row, 0);
  float sums[2] = {};
  RowShares shares = {kMinusInfinity, 0};
  if (lane < job.n_split) shares = {partial[lane * stride + job.d_head], partial[lane * stride + job.d_head + 1]};
  for (int first = 0; first < job.n_split; first += kAtOnce) {
    float values[kAtOnce][2];
#pragma unroll
    for (int z = 0; z < kAtOnce; ++z)
#pragma unroll
      for (int j = 0; j < 2; ++j)
        values[z][j] =
            first + z < job.n_split && i + j * 32 < job.d_head ? partial[(first + z) * stride + i + j * 32] : 0;
    if (first == 0) shares.weigh();
    shares.add(first, values, sums);
  }
#pragma unroll
  for (int j = 0; j < 2; ++j)
    if (i + j * 32 < job.d_head) store_y(job, unit, row, i + j * 32, sums[j] / shares.total);
}

}  // namespace vla::cuda
