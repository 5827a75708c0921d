// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Compiled with -ffp-contract=off: every machine makes the same codes.
#include "kernels/quantize_weights.h"

#include <algorithm>
#include <limits>

namespace vla::kernels {
namespace {

constexpr float kMinScale = 1e-30f;  // 127 / max_abs is finite; values below it are as good as zero
constexpr float kRound = 0x1.8p23f;  // adding it leaves an integer in the lowest bits, ties to even

/// Widens a row, and gives its greatest value without sign: NaN or infinity where one is not finite.
template <DType kType>
float widen(const std::byte* stored, std::int64_t n, float* row) {
  std::int32_t max_abs = 0;  // without their signs, floats are ordered as integers are, and NaN is above them all
  for (std::int64_t k = 0; k < n; ++k) {
    row[k] = stored_number(kType, stored, k);
    max_abs = std::max(max_abs, std::bit_cast<std::int32_t>(row[k]) & 0x7fffffff);
  }
  return std::bit_cast<float>(max_abs);
}

float widen(DType type, const std::byte* stored, std::int64_t n, float* row) {
  return type == DType::f32   ? widen<DType::f32>(stored, n, row)
         : type == DType::f16 ? widen<DType::f16>(stored, n, row)
                              : widen<DType::bf16>(stored, n, row);
}

/// The codes of a block for values that are code * step, and the sum of squares of what they miss.
float try_step(const float* x, float step, float* codes) {
  constexpr int kLanes = 8;  // of sums, whose order is part of the result
  constexpr auto kMost = static_cast<float>(Int4Block::kMost);
  const float inverse = 1 / step;
  float missed[kLanes] = {};
  for (int k = 0; k < Int4Block::kElements; k += kLanes)
    for (int j = 0; j < kLanes; ++j) {
      const float code = std::min(std::max(x[k + j] * inverse + kRound - kRound, -kMost), kMost);
      const float miss = x[k + j] - code * step;
      codes[k + j] = code;
      missed[j] += miss * miss;
    }
  float sum = 0;
  for (const float lane : missed) sum += lane;
  return sum;
}

/// The block with the least error of those whose step is a multiple of `unit`: the one that its largest number needs,
/// or a smaller one, which cuts that number and is finer for the others.
Int4Block best_block(const float* x, float unit) {
  constexpr int kMaxStep = Int4Block::kMaxStep;
  float max_abs = 0, codes[Int4Block::kElements], best_codes[Int4Block::kElements] = {};
  for (int k = 0; k < Int4Block::kElements; ++k) max_abs = std::max(max_abs, std::max(x[k], -x[k]));
  const int widest = std::min(kMaxStep, static_cast<int>(max_abs / (Int4Block::kMost * unit)) + 1);
  Int4Block block = {.step = 0, .codes = {}};
  float least = std::numeric_limits<float>::infinity();
  for (int step = widest; max_abs > 0 && step > 0 && 2 * step >= widest; --step) {
    const float missed = try_step(x, static_cast<float>(step) * unit, codes);
    if (missed >= least) continue;
    least = missed, block.step = static_cast<std::uint8_t>(step);
    std::copy(codes, codes + Int4Block::kElements, best_codes);
  }
  for (std::size_t i = 0; i < block.codes.size(); ++i) {
    const int low = static_cast<int>(best_codes[2 * i]) + Int4Block::kZero;
    const int high = static_cast<int>(best_codes[2 * i + 1]) + Int4Block::kZero;
    block.codes[i] = static_cast<std::uint8_t>(low | high << 4);
  }
  return block;
}

/// The scale that makes what is left of the row least: the values' projection on their codes.
float fitted_scale(const float* row, const Int4Block* blocks, std::int64_t n, float otherwise) {
  double product = 0, square = 0;
  for (std::int64_t k = 0; k < n; ++k) {
    const double code = blocks[k / Int4Block::kElements][k % Int4Block::kElements];
    product += row[k] * code, square += code * code;
  }
  return square > 0 ? static_cast<float>(product / square) : otherwise;
}

}  // namespace

void quantize_weights(DType type, const std::byte* stored, std::int64_t d_in, std::int64_t d_out, std::byte* codes,
                      float* scales, float* row) {
  for (std::int64_t n = 0; n < d_out; ++n, stored += d_in * number_size(type), codes += d_in) {
    const float max_abs = widen(type, stored, d_in, row);
    const bool is_finite = max_abs <= std::numeric_limits<float>::max();
    const float a = is_finite ? max_abs : 0, s = a > kMinScale ? 127 / a : 0;
    scales[n] = !is_finite ? std::numeric_limits<float>::quiet_NaN() : s > 0 ? a / 127 : 0;
    for (std::int64_t k = 0; k < d_in; ++k)
      codes[k] = s > 0 ? static_cast<std::byte>(std::bit_cast<std::int32_t>(row[k] * s + kRound)) : std::byte{0};
  }
}

void quantize_weights(DType type, const std::byte* stored, std::int64_t d_in, std::int64_t d_out, Int4Block* blocks,
                      float* scales, float* row) {
  const std::int64_t n_block = d_in / Int4Block::kElements;
  for (std::int64_t n = 0; n < d_out; ++n, stored += d_in * number_size(type), blocks += n_block) {
    const float max_abs = widen(type, stored, d_in, row);
    const bool is_finite = max_abs <= std::numeric_limits<float>::max();
    if (!is_finite || max_abs <= kMinScale) std::fill(row, row + d_in, 0.0f);
    const float unit = max_abs / (Int4Block::kMost * Int4Block::kMaxStep);
    for (std::int64_t i = 0; i < n_block; ++i) blocks[i] = best_block(row + i * Int4Block::kElements, unit);
    scales[n] = is_finite ? fitted_scale(row, blocks, d_in, 0) : std::numeric_limits<float>::quiet_NaN();
  }
}

}  // namespace vla::kernels
