// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <span>
#include <vector>

#include "graph/graph.h"

namespace vla {

/// How a reference rounds the angles in float32. quotient: position / base^(2i/d). product: position times the rounded
/// 1 / base^(2i/d). At position 800 the two differ by up to 6e-5. Sources: lerobot
/// policies/smolvla/smolvlm_with_expert.py apply_rope; transformers modeling_gemma.py GemmaRotaryEmbedding. bfloat16:
/// like product, but position, 1 / base^(2i/d), their product, its cosine and its sine are each rounded to bfloat16. At
/// position 500 an angle differs from the other rules by up to 3.
enum class RotaryAngle { quotient, product, bfloat16 };

/// Rotary embedding, half-split pairing: (x_i, x_{i + d/2}) are rotated by position / base^(2i/d). Token j of x has the
/// position `first` + j. x [d_head, n_head, n_token] -> the same shape; d_head must be even.
Tensor apply_rope(Graph& g, Tensor x, float base, RotaryAngle angle, int first);
/// The same with the angles of a table [d_head, n_token] that every batch shares. x [d_head, n_head, n_token, n_batch].
inline Tensor apply_rope(Graph& g, Tensor x, Tensor table) { return g.add(op::Rope{}, {x, table}); }

/// VLA-Adapter's rotary embedding. It pairs neighbours but takes the angles of half-split pairing, so the two elements
/// of a pair turn by different angles: element j of a head by position / base^(2 (j mod d/2) / d). The reference casts
/// its head, including the frequencies, to bfloat16 and computes the table in bfloat16, in training too. Token i has
/// position i. x [d_head, n_head, n_token] -> the same shape. In each head of the result the first elements of all
/// pairs precede the second elements; products of queries and keys do not depend on this order. Source: VLA-Adapter
/// prismatic/models/action_heads.py RotaryPositionEmbedding, apply_rope; experiments/robot/openvla_utils.py
/// get_action_head.
Tensor apply_uneven_rope(Graph& g, Tensor x, float base);

/// The rotary table of tokens at `positions`: [d_head, n_token], per token d/2 cosines, then d/2 sines.
Tensor rotary_table(Graph& g, int d_head, float base, RotaryAngle angle, std::span<const int> positions);

/// mRoPE position id of a token: time, row and column.
using PositionId = std::array<int, 3>;

/// The table of patches: the first half of the pairs is rotated by row / base^(4i/d), the second half by column /
/// base^(4i/d). d_head must be divisible by 4. Source: transformers modeling_qwen3_vl.py
/// Qwen3VLVisionModel.rot_pos_emb.
Tensor grid_rotary_table(Graph& g, int d_head, float base, const std::vector<PositionId>& positions);

/// The table of `n_first` tokens that are not rotated, followed by the patches of an image in rows. The first half of
/// the pairs is rotated by 2 pi y / base^(4i/d), the second half by 2 pi x / base^(4i/d), where (x, y) is the patch's
/// centre and the image spans -1 to 1. d_head must be divisible by 4. Source: transformers modeling_dinov3_vit.py
/// DINOv3ViTRopePositionEmbedding.
Tensor centre_rotary_table(Graph& g, int d_head, float base, int n_first, int n_row, int n_column);

/// The mRoPE table of images within text: pair i is rotated by time, row or column / base^(2i/d). Rows take the
/// `sections[1]` pairs 1, 4, 7, ..., columns the `sections[2]` pairs 2, 5, 8, ..., time all others. Source:
/// transformers modeling_qwen3_vl.py Qwen3VLTextRotaryEmbedding.apply_interleaved_mrope.
Tensor mrope_table(Graph& g, int d_head, float base, const std::array<int, 3>& sections,
                   const std::vector<PositionId>& positions);

}  // namespace vla
