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
/// the scale that fits its codes best. blocks: d_in / 64 of a row.
void quantize_weights(DType type, const std::byte* stored, std::int64_t d_in, std::int64_t d_out, Int4Block* blocks,
                      float* scales, float* row);

}  // namespace vla::kernels
