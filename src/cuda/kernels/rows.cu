// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/rows.h"

#include "cuda/kernels/device.h"

namespace vla::cuda {
namespace {

VLA_DEVICE float sum_of_block(float x, std::byte* room) {
  __syncthreads();  // earlier values may still be read
  return across_warps(sum_of_warp(x), room, [](float a, float b) { return a + b; });
}

/// Writes a normalized row as codes, equal to quantize_row of kernels/quantized.h to the bit. `value(i)` is element i.
template <class Value>
VLA_DEVICE void store_codes(std::byte* y, int n, std::byte* room, Value value) {
  constexpr float kRound = 12582912.0f;  // 1.5 * 2^23: adding it leaves an integer in the lowest bits, ties to even
  const int n_thread = static_cast<int>(blockDim.x), depth = (n + 63) / 64 * 64;
  int most = 0;  // without their signs, floats order like integers, with NaN above all
  for (int i = thread_index(); i < n; i += n_thread) {
    const int size = dev::bits_of(value(i)) & 0x7fffffff;
    most = size > most ? size : most;
  }
  __syncthreads();
  most = across_warps(most_of_warp(most), room, [](int a, int b) { return a > b ? a : b; });
  const float a = dev::float_of(most);
  const float s = dev::multiply(dev::divide(1.0f, a < 1e-5f ? 1e-5f : a), 127.0f);
  int sum = 0;
  for (int i = thread_index() * 4; i < depth; i += n_thread * 4) {
    unsigned four = 0;
    for (int b = 0; b < 4; ++b) {
      const float rounded = i + b < n ? dev::add(dev::multiply(value(i + b), s), kRound) : kRound;
      const unsigned code = static_cast<unsigned>(dev::bits_of(rounded)) & 0xff;
      four |= code << 8 * b;
      sum += static_cast<int>(code << 24) >> 24;
    }
    *reinterpret_cast<unsigned*>(y + i) = four;
  }
  __syncthreads();
  sum = across_warps(sum_of_warp(sum), room, [](int one, int other) { return one + other; });
  if (thread_index() < 16) {  // the 64 bytes after the codes
    const unsigned word = thread_index() == 0   ? static_cast<unsigned>(dev::bits_of(s))
                          : thread_index() == 1 ? static_cast<unsigned>(sum)
                                                : 0;
    reinterpret_cast<unsigned*>(y + depth)[thread_index()] = word;
  }
}

}  // namespace

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

/// A warp computes a row of a head; a lane the pairs (i, i + d_head / 2) of every 32nd i.
VLA_KERNEL(head_rows, 128, 4, HeadJob) {
  const int lane = thread_index() % kLanes, half = job.d_head / 2;
  const std::int64_t number = static_cast<std::int64_t>(blockIdx.x) * 4 + thread_index() / kLanes;
  if (number >= static_cast<std::int64_t>(job.n_head) * job.n_token * job.n_batch) return;  // the whole warp
  const std::int64_t head = number % job.n_head, token = number / job.n_head % job.n_token,
                     batch = number / job.n_head / job.n_token;
  const float* x = job.x + head * job.x_head + token * job.x_token + batch * job.x_batch;
  float factor = 1;
  if (job.weight) {
    float squares = 0;
    for (int i = lane; i < job.d_head; i += kLanes) squares += x[i] * x[i];
    factor = 1 / sqrtf(sum_of_warp(squares) / static_cast<float>(job.d_head) + job.eps);
  }
  const auto normed = [&](int i) { return job.weight ? x[i] * factor * job.weight[i] : x[i]; };
  const std::int64_t to = head * job.y_head + token * job.y_token + batch * job.y_batch;
  for (int i = lane; i < half; i += kLanes) {
    const float low = normed(i), high = normed(i + half);
    const float cosine = job.table ? job.table[token * job.d_head + i] : 1;
    const float sine = job.table ? job.table[token * job.d_head + half + i] : 0;
    store(job.y, job.is_bf16, to + i, low * cosine - high * sine);
    store(job.y, job.is_bf16, to + i + half, high * cosine + low * sine);
  }
}

VLA_KERNEL(lookup_rows, 128, 8, LookupJob) {
  const std::int64_t row = blockIdx.x;
  const int id = job.ids[row];
  const bool valid = id >= 0 && id < job.n_table;
  for (int i = thread_index(); i < job.n; i += 128) {
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
