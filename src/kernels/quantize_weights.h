// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/numbers.h"

namespace vla::kernels {

/// Quantizes a matrix of floats to int8: the largest magnitude in a row of W becomes 127, and value = scale * code,
/// approximately. A row with a value that is not finite gets a scale that makes its products not finite. stored: d_out
/// rows of d_in elements; codes: the same in bytes; scales [d_out]; row: buffer for d_in elements.
void quantize_weights(DType type, const std::byte* stored, std::int64_t d_in, std::int64_t d_out, std::byte* codes,
                      float* scales, float* row);

/// Quantizes to int4: each block gets the step with the least squared error, then each row gets the scale that fits its
/// codes best. blocks: Int4Block::n_of(d_in) per row; row: buffer for the elements of a row's blocks.
void quantize_weights(DType type, const std::byte* stored, std::int64_t d_in, std::int64_t d_out, Int4Block* blocks,
                      float* scales, float* row);

/// With feedback, columns are rounded in stretches of this many, independently of other stretches.
constexpr std::int64_t kStretch = 1024;

/// Quantize to int8 and int4 with feedback from calibration: later columns compensate the errors of earlier ones.
/// feedback: for each stretch of n <= kStretch columns an [n, n] matrix; row j holds the numbers to add to columns
/// k > j for an error of 1 in column j. Codes are computed column by column; the step of an int4 block is chosen before
/// its codes, from the block's compensated values. rows: buffer for d_out * d_in floats.
void quantize_weights(DType type, const std::byte* stored, std::int64_t d_in, std::int64_t d_out, const float* feedback,
                      std::byte* codes, float* scales, float* rows);
void quantize_weights(DType type, const std::byte* stored, std::int64_t d_in, std::int64_t d_out, const float* feedback,
                      Int4Block* blocks, float* scales, float* rows);

}  // namespace vla::kernels
