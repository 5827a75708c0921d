// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <span>
#include <vector>

#include "graph/graph.h"

namespace vla {

/// How a reference rounds the angles, in float32: a position divided by base^(2i/d), or multiplied with the rounded
/// 1 / base^(2i/d). At position 800 the two are up to 6e-5 apart. Sources: lerobot
/// policies/smolvla/smolvlm_with_expert.py apply_rope; transformers modeling_gemma.py GemmaRotaryEmbedding.
enum class RotaryAngle { quotient, product };

/// Rotary embedding, half-split pairing: (x_i, x_{i + d/2}) turn by position / base^(2i/d). Token j of x stands at
/// position `first` + j. x [d_head, n_head, n_token] -> the same shape; d_head must be even.
Tensor apply_rope(Graph& g, Tensor x, float base, RotaryAngle angle, int first);
/// The same by the angles of a table [d_head, n_token], which every batch shares. x [d_head, n_head, n_token, n_batch].
inline Tensor apply_rope(Graph& g, Tensor x, Tensor table) { return g.add(op::Rope{}, {x, table}); }

/// The table of tokens at these positions, one for each: [d_head, n_token], per token d/2 cosines, then d/2 sines.
Tensor rotary_table(Graph& g, int d_head, float base, RotaryAngle angle, std::span<const int> positions);

/// mRoPE position id of a token: time, row and column.
using PositionId = std::array<int, 3>;

/// The table of patches: the first half of the pairs turns by row / base^(4i/d), the second half by the column
/// likewise. d_head must be divisible by 4. Source: transformers modeling_qwen3_vl.py Qwen3VLVisionModel.rot_pos_emb.
Tensor grid_rotary_table(Graph& g, int d_head, float base, const std::vector<PositionId>& positions);

/// The table of `n_first` tokens that do not turn and the patches of an image behind them, row by row. The first half
/// of the pairs turns by 2 pi y / base^(4i/d), the second half by x likewise, for a patch whose centre is at (x, y) of
/// an image from -1 to 1. d_head must be divisible by 4. Source: transformers modeling_dinov3_vit.py
/// DINOv3ViTRopePositionEmbedding.
Tensor centre_rotary_table(Graph& g, int d_head, float base, int n_first, int n_row, int n_column);

/// The mRoPE table of images within text: pair i turns by one of the three / base^(2i/d). Rows have the pairs 1, 4, 7,
/// ..., `sections[1]` of them, columns the `sections[2]` pairs 2, 5, 8, ..., time all others. Source: the same file,
/// Qwen3VLTextRotaryEmbedding.apply_interleaved_mrope.
Tensor mrope_table(Graph& g, int d_head, float base, const std::array<int, 3>& sections,
                   const std::vector<PositionId>& positions);

}  // namespace vla
