// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <vector>

#include "nn/rope.h"

namespace vla {

/// Rows and columns of the patches of a picture whose squares of `merge` x `merge` patches follow each other row by
/// row, and the patches of a square likewise: [n_row * n_column], time 0. Source: transformers modeling_qwen3_vl.py
/// Qwen3VLVisionModel.rot_pos_emb.
std::vector<Place> merge_block_places(int n_row, int n_column, int merge);

/// Which rows of a square position table each patch reads, and with which weights: four lists of a number per patch.
struct PositionBlend {
  std::vector<std::int32_t> ids[4];
  std::vector<float> weights[4];
};

/// The position table of `n_side`^2 rows stretched over n_row x n_column patches, so that its corners are those of the
/// picture, for patches at `places`. Weights are float32, as the reference makes them. Source: the same class,
/// fast_pos_embed_interpolate.
PositionBlend blend_positions(const std::vector<Place>& places, int n_row, int n_column, int n_side);

}  // namespace vla
