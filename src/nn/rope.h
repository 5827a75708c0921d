// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>

#include "backend/graph.h"

namespace vla {

/// How a reference rounds the angles, in float32: a position divided by base^(2i/d), or multiplied with the rounded
/// 1 / base^(2i/d). At position 800 the two are up to 6e-5 apart. Sources: lerobot
/// policies/smolvla/smolvlm_with_expert.py apply_rope; transformers modeling_gemma.py GemmaRotaryEmbedding.
enum class RotaryAngle { quotient, product };

/// Rotary embedding, half-split pairing: (x_i, x_{i + d/2}) turn by position / base^(2i/d). Token j of x stands at
/// position `first` + j. x [d_head, n_head, n_token] -> the same shape; d_head must be even.
Tensor rope(Graph& g, Tensor x, float base, RotaryAngle angle, int first);
/// The same where token j stands at positions[j], one for each.
Tensor rope(Graph& g, Tensor x, float base, RotaryAngle angle, std::span<const int> positions);

}  // namespace vla
