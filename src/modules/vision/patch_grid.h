// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <vector>

#include "nn/embedding.h"
#include "nn/rope.h"

namespace vla {

/// Row and column of each patch, for squares of `merge` x `merge` patches in row order and patches within a square in
/// row order: [n_row * n_column], time 0. Source: transformers modeling_qwen3_vl.py Qwen3VLVisionModel.rot_pos_emb.
std::vector<PositionId> merge_block_places(int n_row, int n_column, int merge);

/// How patches interpolate a square position table. `ids[k]` and `weights[k]` have one entry per patch; a patch's
/// position is the weighted sum over k.
struct PositionBlend {
  std::vector<std::vector<std::int32_t>> ids;
  std::vector<std::vector<float>> weights;
};

/// Interpolates a position table of `n_side`^2 rows over n_row x n_column patches so that the corners coincide, for
/// patches at `places`. Weights are float32, as in the reference. Source: the same class, fast_pos_embed_interpolate.
PositionBlend blend_positions(const std::vector<PositionId>& places, int n_row, int n_column, int n_side);

/// Resizes the same table like an image: bilinear, with antialiasing when it shrinks, for patches in row order. Source:
/// transformers modeling_siglip2.py Siglip2VisionEmbeddings.resize_positional_embeddings.
PositionBlend resize_positions(int n_row, int n_column, int n_side);

/// The positions [d, n_patch] interpolated from a table.
Tensor blended(Graph& g, const Embedding& table, const PositionBlend& blend);

}  // namespace vla
