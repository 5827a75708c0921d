// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/kernels/device.h"
#include "cuda/kernels/linear_bf16.h"

/// Norms that one product begins and others end (NormBegin, NormEnd).
namespace vla::cuda {

/// The norm's terms of a row: sums are multiplied by `factor`, and `shift` is factor * mean.
struct RowTerms {
  float factor = 1, shift = 0;
};

/// The terms of a row of x: neutral ones if there is no norm to end, or no such row.
VLA_DEVICE RowTerms terms_of_row(const LinearBf16Job& job, int row) {
  const RowMoments& of = job.norm_end.moments;
  if (of.squares == nullptr || row >= job.n_row) return {};
  const auto at = [&](int part) { return static_cast<std::int64_t>(part) * job.n_row + row; };
  const auto n = static_cast<float>(job.depth);
  float mean = 0, squares = 0;
  if (of.sums != nullptr) {
#pragma unroll 8
    for (int part = 0; part < of.n_part; ++part) mean += of.sums[at(part)];
    mean /= n;
  }
#pragma unroll 8
  for (int part = 0; part < of.n_part; ++part) {
    squares += of.squares[at(part)];
    if (of.sums == nullptr) continue;
    const int left = job.depth - part * of.part;
    const auto of_part = static_cast<float>(left < of.part ? left : of.part);
    const float off = of.sums[at(part)] / of_part - mean;
    squares += of_part * off * off;
  }
  const float factor = 1 / sqrtf(squares / n + job.norm_end.eps);
  return {factor, factor * mean};
}

/// What all rows have in common, of kCount adjacent columns: the products of a norm's weight and bias.
template <int kCount>
struct NormedColumns {
  float weight[kCount] = {}, bias[kCount] = {};

  /// sums_of(row, kCount numbers): the sums of a row of x.
  template <class SumsOf>
  VLA_DEVICE void load(const LinearBf16Job& job, SumsOf sums_of) {
    const int n_of_weight = job.norm_end.moments.sums != nullptr ? 2 : 0;
#pragma unroll 1
    for (int i = 0; i < job.norm_end.n_more(); ++i) {  // a row at a time, which takes few registers
      float row[kCount];
      sums_of(job.n_row + i, row);
#pragma unroll
      for (int c = 0; c < kCount; ++c)
        weight[c] += i < n_of_weight ? row[c] : 0, bias[c] += i < n_of_weight ? 0 : row[c];
    }
  }
  /// The norm's product, from a sum of column c.
  VLA_DEVICE float normed(const RowTerms& row, float sum, int c) const {
    return dev::add(dev::multiply_add(-row.shift, weight[c], dev::multiply(sum, row.factor)), bias[c]);
  }
};

/// Ends the norm of x, if there is one, for TileEnd::finish. kHalves: 2 if there are columns of a gate.
template <int kHalves>
struct EndsNorm {
  const LinearBf16Job& job;
  NormedColumns<4> all[kHalves] = {};

  template <class SumsOf>
  VLA_DEVICE void load(SumsOf sums_of) {
#pragma unroll
    for (int half = 0; half < kHalves; ++half)
      all[half].load(job, [&](int row, float(&to)[4]) {
        const auto sums = sums_of(row, half > 0);
#pragma unroll
        for (int c = 0; c < 4; ++c) to[c] = sums.of[c];
      });
  }
  VLA_DEVICE float operator()(const RowTerms& row, float sum, int c, bool of_gate) const {
    return all[of_gate ? kHalves - 1 : 0].normed(row, sum, c);
  }
};

/// Adds over the lanes that have a part of a row.
template <int kLanesOfPart>
VLA_DEVICE float sum_of_part(float x) {
#pragma unroll
  for (int mask = kLanesOfPart / 2; mask > 0; mask /= 2) x += dev::shuffle_xor(x, mask);
  return x;
}

/// Stores a row of NormBegin::rows, from `column` on; value(column) is an element.
template <int kCount, class Value>
VLA_DEVICE void store_begun(const LinearBf16Job& job, int row, int column, Value value) {
  std::uint16_t* const to = job.norm_begin.rows + row * job.norm_begin.stride;
#pragma unroll
  for (int c = column; c < column + kCount; c += 2) {
    if (c + 1 < job.n_column)
      store_pair(to, true, c, value(c), value(c + 1));
    else if (c < job.n_column)
      store(to, true, c, value(c));
  }
}

/// Stores values rounded, and in the next row what they lack then.
template <int kCount, class Value>
VLA_DEVICE void store_twice(const LinearBf16Job& job, int row, int column, Value value) {
  store_begun<kCount>(job, row, column, value);
  store_begun<kCount>(job, row + 1, column, [&](int c) {
    const float of = value(c);
    return of - dev::float_of(static_cast<int>(dev::to_bf16(of, 0) << 16));
  });
}

/// Begins the norm of a row of y, which has kCount adjacent columns from `column` on in each of kLanesOfPart lanes. All
/// lanes of the warp must call it, also those of rows and columns after the last.
template <int kLanesOfPart, int kCount>
VLA_DEVICE void begin_norm(const LinearBf16Job& job, int row, int column, const float (&y)[kCount]) {
  constexpr int kPart = kLanesOfPart * kCount;
  const NormBegin& norm = job.norm_begin;
  const int part = column / kPart, left = job.n_column - part * kPart;
  float sum = 0, squares = 0, mean = 0;
  if (norm.moments.sums != nullptr) {
#pragma unroll
    for (int c = 0; c < kCount; ++c) sum += column + c < job.n_column ? y[c] : 0;
    sum = sum_of_part<kLanesOfPart>(sum);
    mean = sum / static_cast<float>(left < kPart ? left : kPart);
  }
#pragma unroll
  for (int c = 0; c < kCount; ++c) squares += column + c < job.n_column ? (y[c] - mean) * (y[c] - mean) : 0;
  squares = sum_of_part<kLanesOfPart>(squares);
  if (row >= job.n_row) return;
  if (thread_index() % kLanesOfPart == 0 && left > 0) {
    const std::int64_t at = static_cast<std::int64_t>(part) * job.n_row + row;
    norm.moments.squares[at] = squares;
    if (norm.moments.sums != nullptr) norm.moments.sums[at] = sum;
  }
  const auto weight_of = [&](int c) { return norm.weight ? norm.weight[c] : 1; };
  store_begun<kCount>(job, row, column, [&](int c) { return y[c - column] * weight_of(c); });
  if (row > 0) return;
  const int after = job.n_row + (norm.moments.sums != nullptr ? 2 : 0);
  if (norm.moments.sums != nullptr) store_twice<kCount>(job, job.n_row, column, weight_of);
  if (norm.bias != nullptr) store_twice<kCount>(job, after, column, [&](int c) { return norm.bias[c]; });
}

}  // namespace vla::cuda
