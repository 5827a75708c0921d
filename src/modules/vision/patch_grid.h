// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <vector>

#include "nn/embedding.h"
#include "nn/rope.h"

namespace vla {

/// Rows and columns of the patches of an image whose squares of `merge` x `merge` patches follow each other row by
/// row, and the patches of a square likewise: [n_row * n_column], time 0. Source: transformers modeling_qwen3_vl.py
/// Qwen3VLVisionModel.rot_pos_emb.
std::vector<PositionId> merge_block_places(int n_row, int n_column, int merge);

/// Rows of a square position table that patches read, and with which weights: `ids[k]` and `weights[k]` have a number
/// for each patch, and a patch's position is the sum over k.
struct PositionBlend {
  std::vector<std::vector<std::int32_t>> ids;
  std::vector<std::vector<float>> weights;
};

/// The position table of `n_side`^2 rows stretched over n_row x n_column patches, so that its corners are those of the
/// image, for patches at `places`. Weights are float32, as the reference makes them. Source: the same class,
/// fast_pos_embed_interpolate.
PositionBlend blend_positions(const std::vector<PositionId>& places, int n_row, int n_column, int n_side);

/// The same table resized as an image is: bilinear, with antialiasing where it shrinks, for patches row by row.
/// Source: transformers modeling_siglip2.py Siglip2VisionEmbeddings.resize_positional_embeddings.
PositionBlend resize_positions(int n_row, int n_column, int n_side);

/// Positions [d, n_patch] of a table.
Tensor blended(Graph& g, const Embedding& table, const PositionBlend& blend);

}  // namespace vla
