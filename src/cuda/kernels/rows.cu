// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/rows.h"

#include "cuda/kernels/finish.h"

namespace vla::cuda {
namespace {

VLA_DEVICE float sum_of_block(float x, std::byte* room) {
  __syncthreads();  // earlier values may still be read
  return across_warps(sum_of_warp(x), room, [](float a, float b) { return a + b; });
}

/// Codes of a row are those of quantize_row in kernels/quantized.h, to the bit.
constexpr float kRound = 12582912.0f;  // 1.5 * 2^23: adding it leaves an integer in the lowest bits, ties to even
/// The bits of |x|. As integers they have the order of the floats, with NaN above all.
VLA_DEVICE int size_of(float x) { return dev::bits_of(x) & 0x7fffffff; }
VLA_DEVICE float scale_of(int most) {
  const float a = dev::float_of(most);
  return dev::multiply(dev::divide(1.0f, a < 1e-5f ? 1e-5f : a), 127.0f);
}
/// The code of x: 0 for NaN, as on the CPU, because the bits of a NaN differ between devices.
VLA_DEVICE unsigned code_of(float x, float s) {
  const float rounded = dev::add(dev::multiply(x, s), kRound);
  return rounded == rounded ? static_cast<unsigned>(dev::bits_of(rounded)) & 0xff : 0;
}
VLA_DEVICE int as_signed(unsigned code) { return static_cast<int>(code << 24) >> 24; }
/// Stores the 64 bytes after the codes.
VLA_DEVICE void store_scale(std::byte* end, float s, int sum) {
  if (thread_index() >= 16) return;
  const unsigned scale = s == s ? static_cast<unsigned>(dev::bits_of(s)) : 0x7fc00000;
  reinterpret_cast<unsigned*>(end)[thread_index()] = thread_index() == 0   ? scale
                                                     : thread_index() == 1 ? static_cast<unsigned>(sum)
                                                                           : 0;
}
VLA_DEVICE int larger(int a, int b) { return a > b ? a : b; }
VLA_DEVICE int sum_of(int a, int b) { return a + b; }

/// Writes a normalized row as codes. `value(i)` is element i.
template <class Value>
VLA_DEVICE void store_codes(std::byte* y, int n, std::byte* room, Value value) {
  const int n_thread = static_cast<int>(blockDim.x), depth = (n + 63) / 64 * 64;
  int most = 0;
  for (int i = thread_index(); i < n; i += n_thread) most = larger(size_of(value(i)), most);
  __syncthreads();
  const float s = scale_of(across_warps(most_of_warp(most), room, larger));
  int sum = 0;
  for (int i = thread_index() * 4; i < depth; i += n_thread * 4) {
    unsigned four = 0;
    for (int b = 0; b < 4; ++b) {
      const unsigned code = i + b < n ? code_of(value(i + b), s) : 0;
      four |= code << 8 * b, sum += as_signed(code);
    }
    *reinterpret_cast<unsigned*>(y + i) = four;
  }
  __syncthreads();
  store_scale(y + depth, s, across_warps(sum_of_warp(sum), room, sum_of));
}

/// Loads four adjacent values of a row of aligned fours, or `otherwise` after the row's end or if there is no row.
VLA_DEVICE void load_four(float (&to)[4], const float* row, int i, int n, float otherwise) {
  float4 four = {otherwise, otherwise, otherwise, otherwise};
  if (row && i < n) four = *reinterpret_cast<const float4*>(row + i);
  to[0] = four.x, to[1] = four.y, to[2] = four.z, to[3] = four.w;
}

/// Reduces over a block. Each reduction of a row has its own memory, so one barrier is enough.
constexpr int kReductionRoom = 64;
template <class T, class Combine>
VLA_DEVICE T reduce(T of_warp, int number, Combine combine) {
  return across_warps(of_warp, dev::shared_memory() + number * kReductionRoom, combine);
}
VLA_DEVICE float sum_of_block(float x, int number) {
  return reduce(sum_of_warp(x), number, [](float a, float b) { return a + b; });
}

/// The same as store_codes above, for a row in registers.
template <int kThreads, int kGroups>
VLA_DEVICE void store_codes(std::byte* y, int n, const float (&x)[kGroups][4]) {
  const int depth = (n + 63) / 64 * 64;
  const auto place = [](int j) { return 4 * (thread_index() + kThreads * j); };
  int most = 0;  // values after the row's end are 0, or NaN if the row has one
#pragma unroll
  for (int j = 0; j < kGroups; ++j)
#pragma unroll
    for (int k = 0; k < 4; ++k)
      if (place(j) < n) most = larger(size_of(x[j][k]), most);
  const float s = scale_of(reduce(most_of_warp(most), 2, larger));
  int sum = 0;
#pragma unroll
  for (int j = 0; j < kGroups; ++j) {
    unsigned four = 0;
#pragma unroll
    for (int k = 0; k < 4; ++k) {
      const unsigned code = place(j) < n ? code_of(x[j][k], s) : 0;
      four |= code << 8 * k, sum += as_signed(code);
    }
    if (place(j) < depth) *reinterpret_cast<unsigned*>(y + place(j)) = four;
  }
  store_scale(y + depth, s, reduce(sum_of_warp(sum), 3, sum_of));
}

/// The input x + residual of a row's norm, four values at a time. Every load is issued before the first value is
/// computed.
template <int kGroups>
class Added {
 public:
  VLA_DEVICE void load(const NormJob& job, std::int64_t row, int j, int i) {
    load_four(x_[j], job.x + row * job.x_stride, i, job.n, 0);
    load_four(residual_[j], job.residual ? job.residual + row * job.n : nullptr, i, job.n, kAddsNothing);
  }
  VLA_DEVICE float value(int j, int k) const { return x_[j][k] + residual_[j][k]; }

 private:
  float x_[kGroups][4], residual_[kGroups][4];
};
/// The input of a norm that follows a product: adds the product's sums over the shares of the depth.
template <int kGroups>
class Finished {
 public:
  VLA_DEVICE void load(const LinearBf16Job& job, std::int64_t row, int j, int i) {
    const int n = job.n_column;
    const std::int64_t apart = static_cast<std::int64_t>(job.n_row) * n;
#pragma unroll
    for (int z = 0; z < kMostSplits; ++z)
      load_four(share_[j][z], z < job.n_split ? job.partial + z * apart + row * n : nullptr, i, n, 0);
    load_four(bias_[j], job.end.bias, i, n, kAddsNothing);
    load_four(factor_[j], job.end.factor, i, n, kScalesNothing);
    load_four(residual_[j], job.end.residual ? job.end.residual + row * n : nullptr, i, n, kAddsNothing);
  }
  VLA_DEVICE float value(int j, int k) const {
    float sum = 0;
#pragma unroll
    for (int z = 0; z < kMostSplits; ++z) sum += share_[j][z][k];
    return dev::add(dev::multiply(dev::add(sum, bias_[j][k]), factor_[j][k]), residual_[j][k]);
  }

 private:
  float share_[kGroups][kMostSplits][4], bias_[kGroups][4], factor_[kGroups][4], residual_[kGroups][4];
};

/// Writes four adjacent values of a normalized row.
VLA_DEVICE void store_four(const NormJob& job, std::int64_t row, int i, const float (&x)[4]) {
  const std::int64_t to = row * job.y_stride + i;
  if (i >= job.n) return;
  if (job.type == RowType::bf16)
    *reinterpret_cast<uint2*>(static_cast<std::uint16_t*>(job.y) + to) =
        uint2{dev::to_bf16(x[0], x[1]), dev::to_bf16(x[2], x[3])};
  else
    *reinterpret_cast<float4*>(static_cast<float*>(job.y) + to) = float4{x[0], x[1], x[2], x[3]};
}

/// Normalizes a row in registers, up to 4 kGroups values in each of kThreads threads; `thread` is this thread's index.
/// Issues all loads at once. of: Added or Finished, which reads the operands `from`. sum_of_row(x, number): sums x over
/// the threads; number is 0 or 1, the first or second sum of the row. store(x): receives the normalized row.
template <int kGroups, int kThreads, class Of, class From, class Sum, class Store>
VLA_DEVICE void norm_in_registers(const NormJob& job, std::int64_t row, int thread, Of of, const From& from,
                                  Sum sum_of_row, Store store) {
  const int n = job.n;
  const auto place = [&](int j) { return 4 * (thread + kThreads * j); };
  // Weights are loaded early if the row leaves registers for them, else when they are used.
  constexpr bool kEarly = kGroups <= 2;
  float x[kGroups][4], weight[kGroups][4], bias[kGroups][4];
  const auto load_weights = [&](int j) {
    load_four(weight[j], job.weight, place(j), n, kScalesNothing);
    load_four(bias[j], job.bias, place(j), n, kAddsNothing);
  };
#pragma unroll
  for (int j = 0; j < kGroups; ++j) {
    of.load(from, row, j, place(j));
    if (kEarly) load_weights(j);
  }
  float sum = 0;
#pragma unroll
  for (int j = 0; j < kGroups; ++j) {
#pragma unroll
    for (int k = 0; k < 4; ++k) {
      x[j][k] = place(j) < n ? of.value(j, k) : 0;
      sum += x[j][k];
    }
    if (job.sum && place(j) < n)
      *reinterpret_cast<float4*>(job.sum + row * n + place(j)) = float4{x[j][0], x[j][1], x[j][2], x[j][3]};
  }
  float mean = 0, factor = 1;
  if (job.norm == RowNorm::layer) mean = sum_of_row(sum, 0) / static_cast<float>(n);
  if (job.norm != RowNorm::none) {
    float squares = 0;
#pragma unroll
    for (int j = 0; j < kGroups; ++j)
#pragma unroll
      for (int k = 0; k < 4; ++k) squares += place(j) < n ? (x[j][k] - mean) * (x[j][k] - mean) : 0;
    factor = 1 / sqrtf(sum_of_row(squares, 1) / static_cast<float>(n) + job.eps);
  }
#pragma unroll
  for (int j = 0; j < kGroups; ++j) {
    if (!kEarly) load_weights(j);
#pragma unroll
    for (int k = 0; k < 4; ++k)
      x[j][k] = dev::add(dev::multiply(dev::multiply(x[j][k] - mean, factor), weight[j][k]), bias[j][k]);
  }
  store(x);
}

/// Normalizes one row per block.
template <int kGroups, int kThreads = 256, class Of, class From>
VLA_DEVICE void norm_of_block(const NormJob& job, Of of, const From& from) {
  const std::int64_t row = blockIdx.x;
  norm_in_registers<kGroups, kThreads>(
      job, row, thread_index(), of, from, [](float x, int number) { return sum_of_block(x, number); },
      [&](const float(&x)[kGroups][4]) {
        if (job.type == RowType::codes)
          return store_codes<kThreads>(static_cast<std::byte*>(job.y) + row * job.y_stride, job.n, x);
#pragma unroll
        for (int j = 0; j < kGroups; ++j) store_four(job, row, 4 * (thread_index() + kThreads * j), x[j]);
      });
}

}  // namespace

VLA_KERNEL(norm_rows_2, 256, 4, NormJob) { norm_of_block<2>(job, Added<2>{}, job); }
VLA_KERNEL(norm_rows_4, 256, 3, NormJob) { norm_of_block<4>(job, Added<4>{}, job); }
VLA_KERNEL(norm_rows_8, 512, 2, NormJob) { norm_of_block<4, 512>(job, Added<4>{}, job); }
VLA_KERNEL(finish_norm_rows_1, 256, 2, FinishNormJob) { norm_of_block<1>(job.norm, Finished<1>{}, job.product); }
VLA_KERNEL(finish_norm_rows_2, 256, 2, FinishNormJob) { norm_of_block<2>(job.norm, Finished<2>{}, job.product); }

/// Normalizes one row per warp.
VLA_KERNEL(norm_many_rows, 128, 4, NormJob) {
  constexpr int kGroups = kOfWarp / 4 / kLanes;
  const int lane = thread_index() % kLanes;
  const std::int64_t row = static_cast<std::int64_t>(blockIdx.x) * kRowsOfBlock + thread_index() / kLanes;
  if (row >= job.n_row) return;  // the whole warp
  norm_in_registers<kGroups, kLanes>(
      job, row, lane, Added<kGroups>{}, job, [](float x, int) { return sum_of_warp(x); },
      [&](const float(&x)[kGroups][4]) {
#pragma unroll
        for (int j = 0; j < kGroups; ++j) store_four(job, row, 4 * (lane + kLanes * j), x[j]);
      });
}

/// A block computes one row, which stays in shared memory if it fits.
VLA_KERNEL(norm_rows, 256, 4, NormJob) {
  std::byte *room = dev::shared_memory(), *row_room = room + 64;
  const std::int64_t row = blockIdx.x;
  const int n = job.n, n_thread = static_cast<int>(blockDim.x);
  const bool is_kept = n <= kMaxKept;
  const auto load = [&](int i) {
    const float x = job.x[row * job.x_stride + i];
    return job.residual ? x + job.residual[row * n + i] : x;
  };
  const auto at = [&](int i) { return is_kept ? dev::read<float>(row_room + i * 4) : load(i); };

  float sum = 0;
  for (int i = thread_index(); i < n; i += n_thread) {
    const float x = load(i);
    if (job.sum) job.sum[row * n + i] = x;
    if (is_kept) dev::write(row_room + i * 4, x);
    sum += x;
  }
  float mean = 0, factor = 1;
  if (job.norm == RowNorm::layer) mean = sum_of_block(sum, room) / static_cast<float>(n);
  if (job.norm != RowNorm::none) {
    float squares = 0;
    for (int i = thread_index(); i < n; i += n_thread) squares += (at(i) - mean) * (at(i) - mean);
    factor = 1 / sqrtf(sum_of_block(squares, room) / static_cast<float>(n) + job.eps);
  }
  __syncthreads();  // a thread reads what others have written
  const auto normed = [&](int i) {
    float x = dev::multiply(at(i) - mean, factor);  // recomputed with the same bits each time
    if (job.weight) x = dev::multiply(x, job.weight[i]);
    return job.bias ? dev::add(x, job.bias[i]) : x;
  };
  if (job.type == RowType::codes)
    return store_codes(static_cast<std::byte*>(job.y) + row * job.y_stride, n, room, normed);
  for (int i = thread_index(); i < n; i += n_thread)
    store(job.y, job.type == RowType::bf16, row * job.y_stride + i, normed(i));
}

/// A warp computes one row of a head. A lane computes the pairs (i, i + d_head / 2) of every 32nd i and loads kAtOnce
/// pairs at a time.
VLA_DEVICE void turn_heads(const HeadJob& job, int block) {
  constexpr int kAtOnce = 4;
  const int lane = thread_index() % kLanes, half = job.d_head / 2;
  const int number = block * 4 + thread_index() / kLanes;
  if (number >= job.n_head * job.n_token * job.n_batch) return;  // the whole warp
  const std::int64_t head = number % job.n_head, token = number / job.n_head % job.n_token,
                     batch = number / job.n_head / job.n_token;
  const float* x = job.x + head * job.x_head + token * job.x_token + batch * job.x_batch;
  const float* table = job.table ? job.table + token * job.d_head : nullptr;
  float factor = 1;
  if (job.weight) {
    float squares = 0;
    for (int i = lane; i < job.d_head; i += kLanes) squares += x[i] * x[i];
    factor = 1 / sqrtf(sum_of_warp(squares) / static_cast<float>(job.d_head) + job.eps);
  }
  const auto normed = [&](float value, int i) { return job.weight ? value * factor * job.weight[i] : value; };
  const std::int64_t to = head * job.y_head + token * job.y_token + batch * job.y_batch;
#pragma unroll 1
  for (int first = lane; first < half; first += kLanes * kAtOnce) {
    float low[kAtOnce] = {}, high[kAtOnce] = {}, cosine[kAtOnce] = {}, sine[kAtOnce] = {};
#pragma unroll
    for (int k = 0; k < kAtOnce; ++k) {
      const int i = first + kLanes * k;
      if (i >= half) break;
      low[k] = normed(x[i], i), high[k] = normed(x[i + half], i + half);
      cosine[k] = table ? table[i] : 1, sine[k] = table ? table[half + i] : 0;
    }
    rotate(low, high, cosine, sine);
#pragma unroll
    for (int k = 0; k < kAtOnce; ++k) {
      const int i = first + kLanes * k;
      if (i >= half) break;
      store(job.y, job.is_bf16, to + i, low[k]);
      store(job.y, job.is_bf16, to + i + half, high[k]);
    }
  }
}
VLA_KERNEL(head_rows, 128, 4, HeadJob) { turn_heads(job, static_cast<int>(blockIdx.x)); }
VLA_KERNEL(several_head_rows, 128, 4, Several<HeadJob>) {
  run_one(job, blockIdx.x, [](const HeadJob& one, int block) { turn_heads(one, block); });
}

VLA_KERNEL(lookup_rows, 128, 8, LookupJob) {
  const std::int64_t row = blockIdx.x;
  const int id = job.ids[row];
  const bool valid = id >= 0 && id < job.n_table;
  const int first = static_cast<int>(blockIdx.y) * kLookupBlock, end = first + kLookupBlock;
  for (int i = first + thread_index(); i < job.n && i < end; i += 128) {
    const std::int64_t at = static_cast<std::int64_t>(valid ? id : 0) * job.n + i;
    float value = 0;
    if (job.type == TableType::f32) {
      value = static_cast<const float*>(job.table)[at];
    } else {
      const unsigned bits = static_cast<const std::uint16_t*>(job.table)[at];
      value = job.type == TableType::bf16 ? from_bf16(static_cast<std::uint16_t>(bits)) : dev::from_f16(bits);
    }
    job.y[row * job.n + i] = valid ? value : dev::float_of(0x7fc00000);
  }
}

}  // namespace vla::cuda
