// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// Compiled with -ffp-contract=off, so every machine computes the same codes.
#include "kernels/quantize_weights.h"

#include <algorithm>
#include <limits>
#include <span>
#include <vector>

namespace vla::kernels {
namespace {

constexpr float kMinScale = 1e-30f;  // keeps 127 / max_abs finite; smaller values count as zero
constexpr float kRound = 0x1.8p23f;  // adding this constant leaves an integer in the lowest bits, ties to even

/// Widens a row and returns its largest magnitude; NaN or infinity if a value is not finite.
template <DType kType>
float widen(const std::byte* stored, std::int64_t n, float* row) {
  std::int32_t max_abs = 0;  // bits of |x|, which have the order of the floats, with NaN above all
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

/// Computes the codes of a block for a step. Returns the sum of squared errors.
float try_step(const float* x, float step, float* codes) {
  constexpr int kLanes = 8;  // partial sums; their order is part of the result
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

/// Returns the step, in units of `unit`, with the least squared error, and writes its codes; 0 for a block of zeros.
/// Candidates are the step that the block's largest value needs, and smaller ones, which clip the largest value but
/// round the other values more finely.
int best_step(const float* x, float unit, float* best_codes) {
  constexpr int kMaxStep = Int4Block::kMaxStep;
  float max_abs = 0, codes[Int4Block::kElements];
  for (int k = 0; k < Int4Block::kElements; ++k) max_abs = std::max(max_abs, std::max(x[k], -x[k]));
  std::fill(best_codes, best_codes + Int4Block::kElements, 0.0f);
  if (!(max_abs > 0)) return 0;
  const int widest = static_cast<int>(std::min(max_abs / (Int4Block::kMost * unit), kMaxStep - 1.0f)) + 1;
  int best = 0;
  float least = std::numeric_limits<float>::infinity();
  for (int step = widest; step > 0 && 2 * step >= widest; --step) {
    const float missed = try_step(x, static_cast<float>(step) * unit, codes);
    if (missed >= least) continue;
    least = missed, best = step;
    std::copy(codes, codes + Int4Block::kElements, best_codes);
  }
  return best;
}

Int4Block packed(int step, const float* codes) {
  Int4Block block = {.step = static_cast<std::uint8_t>(step), .codes = {}};
  for (std::size_t i = 0; i < block.codes.size(); ++i) {
    const int low = static_cast<int>(codes[2 * i]) + Int4Block::kZero;
    const int high = static_cast<int>(codes[2 * i + 1]) + Int4Block::kZero;
    block.codes[i] = static_cast<std::uint8_t>(low | high << 4);
  }
  return block;
}

/// The scale with the least squared error for these codes: the projection of the values on the codes.
float fitted_scale(const float* row, const Int4Block* blocks, std::int64_t n, float otherwise) {
  double product = 0, square = 0;
  for (std::int64_t k = 0; k < n; ++k) {
    const double code = blocks[k / Int4Block::kElements][k % Int4Block::kElements];
    product += row[k] * code, square += code * code;
  }
  return square > 0 ? static_cast<float>(product / square) : otherwise;
}

/// What widen_row finds out about a row.
struct WideRow {
  float unit;  // value of code 1: the largest magnitude divided by its code; 0 for a row of zeros
  bool is_finite;
};

constexpr float kInt8Codes = 127, kInt4Codes = Int4Block::kMost * Int4Block::kMaxStep;

/// Widens a row; a row that is not finite, or nearly zero, becomes zeros. n_code: the code of the largest magnitude.
WideRow widen_row(DType type, const std::byte* stored, std::int64_t d_in, float n_code, float* row) {
  const float max_abs = widen(type, stored, d_in, row);
  const bool is_finite = max_abs <= std::numeric_limits<float>::max();
  const bool is_zero = !is_finite || max_abs <= kMinScale;
  if (is_zero) std::fill(row, row + d_in, 0.0f);
  return {is_zero ? 0 : max_abs / n_code, is_finite};
}

/// Widens all rows into `rows`. Returns their units; `scales` receives them, or NaN for a row that is not finite.
std::vector<float> widen_rows(DType type, const std::byte* stored, std::int64_t d_in, std::int64_t d_out, float n_code,
                              float* scales, float* rows) {
  std::vector<float> units;
  for (std::int64_t n = 0; n < d_out; ++n) {
    const WideRow of = widen_row(type, stored + n * d_in * number_size(type), d_in, n_code, rows + n * d_in);
    units.push_back(of.unit);
    scales[n] = of.is_finite ? of.unit : std::numeric_limits<float>::quiet_NaN();
  }
  return units;
}

/// Rounds some rows of a stretch of columns; later columns compensate the errors of earlier ones.
class Stretch {
 public:
  /// rows: address of the first row's element in the first column. units: for each row, the value of code 1 (int8) or
  /// of step 1 (int4). feedback: [n, n].
  Stretch(const float* rows, std::int64_t d_in, std::span<const float> units, const float* feedback, std::int64_t n)
      : rows_(rows), d_in_(d_in), units_(units), feedback_(feedback), n_(n), asked_(units.size() * size(n)) {}

  /// Computes the int8 codes of every row. codes: address of the first row's code in the first column.
  void round(std::byte* codes) {
    for (std::size_t k = 0; k < size(n_); ++k)
      for (std::size_t r = 0; r < units_.size(); ++r)
        codes[static_cast<std::int64_t>(r) * d_in_ + static_cast<std::int64_t>(k)] =
            static_cast<std::byte>(static_cast<int>(round(r, k, units_[r], 127)));
  }

  /// Computes the block of every row that starts at column `begin`. blocks: address of the first row's block.
  void round(std::int64_t begin, Int4Block* blocks) {
    const std::size_t first = size(begin);
    std::vector<int> steps;
    std::vector<float> codes(units_.size() * kElements);
    const std::size_t n = std::min(kElements, size(n_) - first);
    for (std::size_t r = 0; r < units_.size(); ++r) {
      float wanted[kElements] = {}, unused[kElements];
      for (std::size_t k = 0; k < n; ++k) wanted[k] = row(r)[first + k] + asked(r)[first + k];
      steps.push_back(best_step(wanted, units_[r], unused));
    }
    // The inner loop runs over rows, so each row of the feedback is read once.
    for (std::size_t k = 0; k < n; ++k)
      for (std::size_t r = 0; r < units_.size(); ++r)
        codes[r * kElements + k] = round(r, first + k, static_cast<float>(steps[r]) * units_[r], Int4Block::kMost);
    for (std::size_t r = 0; r < units_.size(); ++r)
      blocks[static_cast<std::int64_t>(r) * Int4Block::n_of(d_in_)] = packed(steps[r], codes.data() + r * kElements);
  }

 private:
  static constexpr auto kElements = static_cast<std::size_t>(Int4Block::kElements);
  static std::size_t size(std::int64_t n) { return static_cast<std::size_t>(n); }
  const float* row(std::size_t r) const { return rows_ + static_cast<std::int64_t>(r) * d_in_; }
  float* asked(std::size_t r) { return asked_.data() + r * size(n_); }

  /// Rounds one element and adds its error's compensation to later columns of the row. most: the largest code.
  float round(std::size_t r, std::size_t k, float step, float most) {
    float* const more = asked(r);
    const float wanted = row(r)[k] + more[k];
    const float code = step > 0 ? std::min(std::max(wanted / step + kRound - kRound, -most), most) : 0;
    const float error = row(r)[k] - code * step;
    const float* const of_error = feedback_ + k * size(n_);
    for (std::size_t j = k + 1; j < size(n_); ++j) more[j] += error * of_error[j];
    return code;
  }

  const float* rows_;
  std::int64_t d_in_;
  std::span<const float> units_;
  const float* feedback_;
  std::int64_t n_;
  std::vector<float> asked_;  // compensation so far for each element: n columns per row
};

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
  const std::int64_t n_block = Int4Block::n_of(d_in);
  for (std::int64_t n = 0; n < d_out; ++n, stored += d_in * number_size(type), blocks += n_block) {
    const WideRow of = widen_row(type, stored, d_in, kInt4Codes, row);
    std::fill(row + d_in, row + n_block * Int4Block::kElements, 0.0f);
    float codes[Int4Block::kElements];
    for (std::int64_t i = 0; i < n_block; ++i) {
      const int step = best_step(row + i * Int4Block::kElements, of.unit, codes);
      blocks[i] = packed(step, codes);
    }
    scales[n] = of.is_finite ? fitted_scale(row, blocks, d_in, 0) : std::numeric_limits<float>::quiet_NaN();
  }
}

void quantize_weights(DType type, const std::byte* stored, std::int64_t d_in, std::int64_t d_out, const float* feedback,
                      std::byte* codes, float* scales, float* rows) {
  const std::vector<float> units = widen_rows(type, stored, d_in, d_out, kInt8Codes, scales, rows);
  for (std::int64_t first = 0; first < d_in; first += kStretch) {
    const std::int64_t n = std::min(kStretch, d_in - first);
    Stretch(rows + first, d_in, units, feedback, n).round(codes + first);
    feedback += n * n;
  }
}

void quantize_weights(DType type, const std::byte* stored, std::int64_t d_in, std::int64_t d_out, const float* feedback,
                      Int4Block* blocks, float* scales, float* rows) {
  const std::vector<float> units = widen_rows(type, stored, d_in, d_out, kInt4Codes, scales, rows);
  for (std::int64_t first = 0; first < d_in; first += kStretch) {
    const std::int64_t n = std::min(kStretch, d_in - first);
    Stretch stretch(rows + first, d_in, units, feedback, n);
    for (std::int64_t begin = 0; begin < n; begin += Int4Block::kElements)
      stretch.round(begin, blocks + (first + begin) / Int4Block::kElements);
    feedback += n * n;
  }
}

}  // namespace vla::kernels
