// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "backend/graph.h"

namespace vla {

/// Rotary embedding, half-split pairing: (x_i, x_{i + d/2}) turn by position / base^(2i/d). Token j of x stands at
/// position `first` + j. x [d_head, n_head, n_token] -> the same shape; d_head must be even. Source: lerobot
/// policies/smolvla/smolvlm_with_expert.py apply_rope.
Tensor rope(Graph& g, Tensor x, float base, int first);

}  // namespace vla
