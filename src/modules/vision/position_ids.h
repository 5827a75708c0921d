// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "base/result.h"

namespace vla {

/// Which row of the position table each patch of a square image reads, row by row: [n_grid * n_grid].
///
/// The reference places patch i of n at the fraction i/n of the image and looks up the table's interval that holds
/// it, all in floating point. Fractions that equal a boundary in exact arithmetic may fall on either side of it, so the
/// result depends on the precision of the pixels and on the release (docs/bundle.md, `vision.position_rule`); the
/// weights are trained with that result. A grid for which the reference's own result depends on the vector width of the
/// machine (its boundaries are made by torch.arange in blocks) has no right answer, and is refused. Source:
/// transformers modeling_smolvlm.py SmolVLMVisionEmbeddings.forward.
///
/// Towers whose images have one size only have no fractions: `row_major` gives patch i row i. Source: transformers
/// modeling_siglip.py SiglipVisionEmbeddings.forward.
///
/// `rule`: bucketize_float32, bucketize_bfloat16, bucketize_shifted or row_major; `n_table`: rows of the table per
/// side. Errors: bad_bundle for another rule, unsupported for an ambiguous grid, or one that row_major has no table
/// for.
Result<std::vector<std::int32_t>> vision_position_ids(const std::string& rule, int n_grid, int n_table);

}  // namespace vla
