// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/numbers.h"

namespace vla::kernels {

/// A matrix of floats as int8: the greatest value of a row of W becomes 127, and scale * code is nearly the value.
/// A row with a value that is not finite gets a scale that makes its products not finite.
/// stored: d_out rows of d_in elements; codes the same in bytes; scales [d_out]; row: room for d_in elements.
void quantize_weights(DType type, const std::byte* stored, std::int64_t d_in, std::int64_t d_out, std::byte* codes,
                      float* scales, float* row);

/// The same as int4: each block gets the step with which the squares of its errors sum to the least, and the row then
/// the scale that fits its codes best. blocks: Int4Block::n_of(d_in) of a row; row: room for all their elements.
void quantize_weights(DType type, const std::byte* stored, std::int64_t d_in, std::int64_t d_out, Int4Block* blocks,
                      float* scales, float* row);

/// Columns so far apart are rounded as if they had nothing to do with each other.
constexpr std::int64_t kStretch = 1024;

/// The same where it is known what the matrix multiplies, from which follows how an error in one column is made good
/// by those behind it. feedback: for each stretch of n <= kStretch columns an [n, n] matrix, whose row j says what is
/// added to the columns k > j for an error of 1 in column j. Each block gets its step from what is then left of it, and
/// codes column by column. rows: room for d_out * d_in floats.
void quantize_weights(DType type, const std::byte* stored, std::int64_t d_in, std::int64_t d_out, const float* feedback,
                      Int4Block* blocks, float* scales, float* rows);

}  // namespace vla::kernels
