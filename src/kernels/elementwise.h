// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "backend/graph.h"

namespace vla::kernels {

/// GELU in its tanh form, float32 throughout: x * 0.5 * (1 + tanh(sqrt(2/pi) * (x + 0.044715 x^3))). ggml's own
/// operation reads a float16 table, which alone costs more than the parity bar. Any contiguous shape -> the same shape.
/// Source: transformers activations.py NewGELU / torch gelu(approximate="tanh").
Tensor gelu_tanh(Graph& g, Tensor x);

/// GELU as it is defined: x * 0.5 * (1 + erf(x / sqrt(2))), within two units in the last place. With plain ggml
/// operations the sum rounds to a multiple of 2^-24, as torch's does: the tail below -3 loses its digits, and ends at
/// -5.5. Any contiguous shape -> the same shape. Source: torch gelu(approximate="none").
Tensor gelu_erf(Graph& g, Tensor x);

/// max(x, 0), and NaN for NaN, which ggml's own operation makes zero. Any contiguous shape -> the same shape.
/// Source: torch relu.
Tensor relu(Graph& g, Tensor x);

/// x, or a copy of it where it lies in pieces: a view of some tokens of several sequences.
Tensor contiguous(Graph& g, Tensor x);

/// Turns the pairs (x_i, x_{i + d/2}) of every head by the angles of its token, in every batch the same.
/// x [d_head, n_head, n_token, n_batch], table [d_head, n_token] with d/2 cosines, then d/2 sines -> the shape of x.
/// Source: lerobot policies/smolvla/smolvlm_with_expert.py apply_rope.
Tensor rotate_half(Graph& g, Tensor x, Tensor table);

/// Two tensors that differ in one dimension only, one behind the other: [..., n_1, ...], [..., n_2, ...] -> [..., n_1 +
/// n_2, ...], with `dim` the index of that dimension. ggml's own concatenation goes number by number; it is taken where
/// the dimension is not the last one, or a tensor lies in pieces.
Tensor join(Graph& g, Tensor first, Tensor second, int dim);

}  // namespace vla::kernels
