// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "graph/graph.h"

namespace vla {

/// Sinusoidal position embeddings of a grid, in rows: [d_model, n_column * n_row]. The first half of the features
/// encodes the row, the second the column, in pairs of sine and cosine of 2 pi (i + 1) / n at frequencies 10000^(-4 j /
/// d_model). A constant, in float32 as in the reference. d_model must be a multiple of 4. Source: lerobot
/// policies/act/modeling_act.py ACTSinusoidalPositionEmbedding2d.
Tensor sine_positions(Graph& g, int n_column, int n_row, int d_model);

}  // namespace vla
