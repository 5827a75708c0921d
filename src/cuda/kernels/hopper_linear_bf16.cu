// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/finish.h"
#include "cuda/kernels/hopper.h"
#include "cuda/kernels/linear_bf16.h"

namespace vla::cuda {
namespace {

/// A block computes kColumns x kRows sums: y transposed, since the second size of a warpgroup's product may be any
/// multiple of 16, and rows are fewer than columns. Each warpgroup has 64 columns of y and all rows.
template <int kColumns_, int kRows_>
struct Tile {
  static constexpr int kColumns = kColumns_, kRows = kRows_, kThreads = kColumns * 2;
  static constexpr int kStages = hopper_stages(kColumns, kRows), kStage = hopper_stage_bytes(kColumns, kRows);
  static constexpr int kBytesW = kColumns * kSwizzledRow;
};

/// Copies a step of the depth of kRows rows to a stage, eight threads a row, padded with zeros after the last row and
/// the depth.
template <int kRows, int kThreads>
class Fetch {
 public:
  VLA_DEVICE Fetch(const void* from, std::int64_t stride, int row0, int n_row, int depth)
      : stride_(stride * (kRowsAtOnce * 2)), n_left_(n_row - row0 - thread_index() / 8), depth_(depth) {
    const int chunk = thread_index() % 8, row = thread_index() / 8;
    from_ = static_cast<const std::byte*>(from) + ((row0 + row) * stride + chunk * 8) * 2;
    to_ = swizzled(row, chunk);
  }
  VLA_DEVICE void operator()(std::byte* stage, int step) const {
    const int left = (depth_ - step * kHopperDepth - thread_index() % 8 * 8) * 2;
    const int size = left < 0 ? 0 : left > 16 ? 16 : left;
    const std::byte* from = from_ + static_cast<std::int64_t>(step) * (kHopperDepth * 2);
#pragma unroll
    for (int i = 0; i < kRows; i += kRowsAtOnce) {
      if (kRows % kRowsAtOnce != 0 && i + thread_index() / 8 >= kRows) break;
      dev::copy_async(stage + to_ + i * kSwizzledRow, from, i < n_left_ ? size : 0);
      from += stride_;
    }
  }

 private:
  static constexpr int kRowsAtOnce = kThreads / 8;
  static_assert(kRowsAtOnce % kSwizzledRows == 0);
  const std::byte* from_;  // of this thread's first row; nothing is read where a copy's size is 0
  std::int64_t stride_;    // bytes
  int n_left_, depth_, to_;
};

/// Four adjacent sums of a row; those at or after the last column are passed over. Loads of `kBatch` rows are under way
/// at a time.
struct Four {
  float of[4];
};
constexpr int kBatch = 4;

VLA_DEVICE Four load_four(const float* from, bool together, int n) {
  Four to = {};
  if (together) {
    const float4 four = *reinterpret_cast<const float4*>(from);
    to.of[0] = four.x, to.of[1] = four.y, to.of[2] = four.z, to.of[3] = four.w;
  } else {
#pragma unroll
    for (int i = 0; i < 4; ++i)
      if (i < n) to.of[i] = from[i];
  }
  return to;
}
VLA_DEVICE void store_four(float* to, const Four& from, bool together, int n) {
  if (together) {
    *reinterpret_cast<float4*>(to) = float4{from.of[0], from.of[1], from.of[2], from.of[3]};
  } else {
#pragma unroll
    for (int i = 0; i < 4; ++i)
      if (i < n) to[i] = from.of[i];
  }
}
VLA_DEVICE void store_four(std::uint16_t* to, const Four& from, bool together, int n) {
  const unsigned low = dev::to_bf16(from.of[0], from.of[1]), high = dev::to_bf16(from.of[2], from.of[3]);
  if (together) {
    *reinterpret_cast<uint2*>(to) = uint2{low, high};
  } else {
    const unsigned pairs[2] = {low, high};
#pragma unroll
    for (int i = 0; i < 4; ++i)
      if (i < n) to[i] = static_cast<std::uint16_t>(pairs[i / 2] >> i % 2 * 16);
  }
}

/// The end of a tile, whose sums lie in shared memory as rows of kColumns + 4 floats: y, or the sums themselves if the
/// depth is split. A thread has the same four columns of every eighth row.
template <class T>
class Finish {
 public:
  VLA_DEVICE Finish(const LinearBf16Job& job, int row0, int column0)
      : job_(job), row0_(row0), column_(column0 + thread_index() % kQuads * 4), n_(job.n_column - column_) {
    const Epilogue& e = job.end;
    const auto bits = [](const void* p) { return reinterpret_cast<std::uint64_t>(p); };
    const auto all = bits(e.bias) | bits(e.factor) | bits(e.gate) | bits(e.residual) | bits(e.y) | bits(job.partial);
    together_ = job.n_column % 4 == 0 && e.y_stride % 4 == 0 && all % 16 == 0;
    if (n_ <= 0 || job.n_split > 1) return;
    if (e.bias) bias_ = load_four(e.bias + column_, together_, n_);
    if (e.factor) factor_ = load_four(e.factor + column_, together_, n_);
  }
  VLA_DEVICE void operator()(const std::byte* sums) const {
    if (n_ <= 0) return;
    const int first = thread_index() / kQuads, left = job_.n_row - row0_;
    const int end = left < T::kRows ? left : T::kRows;
#pragma unroll 1
    for (int row = first; row < end; row += 8 * kBatch)
      job_.n_split > 1 ? leave(sums, row, end) : finish_rows(sums, row, end);
  }

 private:
  static constexpr int kQuads = T::kColumns / 4;

  VLA_DEVICE Four sums_of(const std::byte* sums, int row) const {
    const auto four = dev::read<float4>(sums + (row * (T::kColumns + 4) + thread_index() % kQuads * 4) * 4);
    return {{four.x, four.y, four.z, four.w}};
  }
  VLA_DEVICE void leave(const std::byte* sums, int row, int end) const {
    float* to = job_.partial + static_cast<std::int64_t>(blockIdx.z) * job_.n_row * job_.n_column + column_;
#pragma unroll
    for (int i = 0; i < kBatch; ++i) {
      const int at = row + 8 * i;
      if (at < end)
        store_four(to + static_cast<std::int64_t>(row0_ + at) * job_.n_column, sums_of(sums, at), together_, n_);
    }
  }
  VLA_DEVICE void finish_rows(const std::byte* sums, int row, int end) const {
    const Epilogue& e = job_.end;
    Four gate[kBatch] = {}, residual[kBatch] = {};
#pragma unroll
    for (int i = 0; i < kBatch; ++i) {
      const std::int64_t at = static_cast<std::int64_t>(row0_ + row + 8 * i) * job_.n_column + column_;
      if (e.gate && row + 8 * i < end) gate[i] = load_four(e.gate + at, together_, n_);
      if (e.residual && row + 8 * i < end) residual[i] = load_four(e.residual + at, together_, n_);
    }
#pragma unroll
    for (int i = 0; i < kBatch; ++i) {
      if (row + 8 * i >= end) break;
      Four y = sums_of(sums, row + 8 * i);
#pragma unroll
      for (int c = 0; c < 4; ++c) y.of[c] = finish_one(y.of[c], c, gate[i].of[c], residual[i].of[c]);
      const std::int64_t at = (row0_ + row + 8 * i) * e.y_stride + column_;
      if (e.is_bf16)
        store_four(static_cast<std::uint16_t*>(e.y) + at, y, together_, n_);
      else
        store_four(static_cast<float*>(e.y) + at, y, together_, n_);
    }
  }
  VLA_DEVICE float finish_one(float sum, int c, float gate, float residual) const {
    const Epilogue& e = job_.end;
    if (e.bias) sum = dev::add(sum, bias_.of[c]);
    sum = e.gate ? dev::multiply(activate(e.activation, gate), sum) : activate(e.activation, sum);
    if (e.factor) sum = dev::multiply(sum, factor_.of[c]);
    if (e.residual) sum = dev::add(sum, residual);
    return e.ends_in_relu ? activate(Activation::relu, sum) : sum;
  }

  const LinearBf16Job& job_;
  int row0_, column_, n_;  // n: columns from column on
  bool together_ = false;
  Four bias_ = {}, factor_ = {};
};

/// Sums to shared memory, transposed: lanes of a warp write to different banks.
template <class T>
VLA_DEVICE void place_sums(const float (&sum)[T::kRows / 2], std::byte* to) {
  const int lane = thread_index() % kLanes, column = thread_index() / kLanes * 16 + lane / 4;
#pragma unroll
  for (int i = 0; i < T::kRows / 2; ++i) {
    const int row = i / 4 * 8 + lane % 4 * 2 + i % 2;
    dev::write(to + (row * (T::kColumns + 4) + column + i / 2 % 2 * 8) * 4, sum[i]);
  }
}

template <class T>
VLA_DEVICE void multiply(const LinearBf16Job& job) {
  std::byte* shared = dev::shared_memory();
  const int row0 = static_cast<int>(blockIdx.x) * T::kRows, column0 = static_cast<int>(blockIdx.y) * T::kColumns;
  const int n_step = (job.depth + kHopperDepth - 1) / kHopperDepth, z = static_cast<int>(blockIdx.z);
  const int first = n_step * z / job.n_split, n = n_step * (z + 1) / job.n_split - first;
  const Fetch<T::kColumns, T::kThreads> fetch_w(job.weight, job.weight_stride, column0, job.n_column, job.depth);
  const Fetch<T::kRows, T::kThreads> fetch_x(job.x, job.x_stride, row0, job.n_row, job.depth);

  float sum[T::kRows / 2] = {};
#pragma unroll
  for (int i = 0; i < T::kStages - 2; ++i)
    if (i < n) fetch_w(shared + i * T::kStage, first + i);
  dev::wait_for_earlier();
#pragma unroll
  for (int i = 0; i < T::kStages - 2; ++i) {
    if (i < n) fetch_x(shared + i * T::kStage + T::kBytesW, first + i);
    dev::commit_copies();  // commits a group even if it is empty, because waiting counts groups
  }
  const std::uint64_t of_stage = T::kStage / 16;
  const std::uint64_t w0 = swizzled_descriptor(shared + thread_index() / 128 * 64 * kSwizzledRow);
  const std::uint64_t x0 = swizzled_descriptor(shared + T::kBytesW);
  int stage = 0, next = T::kStages - 2;
  for (int i = 0; i < n; ++i) {
    dev::wait_copies<T::kStages - 3>();
    dev::fence_async_proxy();
    __syncthreads();  // all warpgroups may multiply the stage, and have multiplied the one that is overwritten next
    const std::uint64_t w = w0 + stage * of_stage, x = x0 + stage * of_stage;
    dev::wgmma_fence();
#pragma unroll
    for (int k = 0; k < 4; ++k) dev::wgmma_bf16<T::kRows>(sum, w + 2 * k, x + 2 * k, i + k > 0);
    dev::wgmma_commit();
    if (const int ahead = i + T::kStages - 2; ahead < n) {
      fetch_w(shared + next * T::kStage, first + ahead);
      fetch_x(shared + next * T::kStage + T::kBytesW, first + ahead);
    }
    dev::commit_copies();
    dev::wgmma_wait<1>();
    stage = stage + 1 == T::kStages ? 0 : stage + 1;
    next = next + 1 == T::kStages ? 0 : next + 1;
  }

  dev::wgmma_wait_all(sum);
  dev::wait_copies<0>();
  __syncthreads();  // the stages' memory is reused for sums
  place_sums<T>(sum, shared);
  __syncthreads();
  Finish<T>(job, row0, column0)(shared);
}

}  // namespace

#define VLA_HOPPER_KERNEL(columns, rows)                                                   \
  VLA_EARLY_KERNEL(hopper_linear_bf16_##columns##x##rows, columns * 2, 1, LinearBf16Job) { \
    multiply<Tile<columns, rows>>(job);                                                    \
  }
VLA_HOPPER_TILES(VLA_HOPPER_KERNEL)

}  // namespace vla::cuda
