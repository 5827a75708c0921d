// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <vector>

#include "graph/graph.h"

namespace vla {

/// Concatenates tensors along dimension `dim`; all other dimensions are equal.
inline Tensor concat(Graph& g, std::vector<Tensor> parts, int dim) {
  return parts.size() == 1 ? parts[0] : g.add(op::Concat{dim}, std::move(parts));
}
/// Concatenates sequences in every view: [d, n_1, n_view], [d, n_2, n_view], ... -> [d, n_1 + n_2 + ..., n_view].
inline Tensor concat_tokens(Graph& g, std::vector<Tensor> parts) { return concat(g, std::move(parts), 1); }
/// Concatenates features of every token: [d_1, n], [d_2, n] -> [d_1 + d_2, n].
inline Tensor concat_features(Graph& g, Tensor first, Tensor second) { return concat(g, {first, second}, 0); }

/// Indices first to first + count - 1 of dimension `dim`.
Tensor slice(Graph& g, Tensor x, int dim, int first, int count);
/// Ids [n] i32 -> [count].
inline Tensor slice_ids(Graph& g, Tensor ids, int first, int count) { return slice(g, ids, 0, first, count); }
/// Features [d, n, ...] -> [count, n, ...].
inline Tensor slice_features(Graph& g, Tensor x, int first, int count) { return slice(g, x, 0, first, count); }
/// Tokens of every view: [d, n, n_view] -> [d, count, n_view].
inline Tensor slice_tokens(Graph& g, Tensor x, int first, int count) { return slice(g, x, 1, first, count); }
/// Keys or values: [d_head, n_head, n] -> [d_head, n_head, count].
inline Tensor slice_keys(Graph& g, Tensor x, int first, int count) { return slice(g, x, 2, first, count); }
/// One view's tokens: [d, n, n_view] -> [d, n].
inline Tensor one_view(Graph& g, Tensor x, int view) { return slice(g, x, 2, view, 1); }

/// A constant: [d, n] of the same value.
Tensor full(Graph& g, float value, std::int64_t d, std::int64_t n);
/// Repeats one vector for every token of `like`: [d, 1] -> [d, n].
Tensor repeat_like(Graph& g, Tensor x, Tensor like);
/// One column of a table, chosen at run time: [d, n], index [1] i32 -> [d, 1].
inline Tensor column(Graph& g, Tensor table, Tensor index) { return g.add(op::Gather{}, {table, index}); }

/// a + b; b is broadcast where it has 1 in a dimension.
inline Tensor add(Graph& g, Tensor a, Tensor b) { return g.add(op::Add{}, {a, b}); }
inline Tensor scale(Graph& g, Tensor x, float factor) { return g.add(op::Scale{factor}, {x}); }
/// Elementwise product. A factor [d] is broadcast over tokens, [1, n] over the elements of a token.
inline Tensor multiply(Graph& g, Tensor x, Tensor factor) { return g.add(op::Multiply{}, {x, factor}); }
/// Source: torch gelu, silu, relu.
inline Tensor activate(Graph& g, Tensor x, Activation activation) { return g.add(op::Activate{activation}, {x}); }
/// x / (1 + exp(-x)).
inline Tensor silu(Graph& g, Tensor x) { return activate(g, x, Activation::silu); }

/// Dimension i of the result is dimension order[i] of x.
inline Tensor permute(Graph& g, Tensor x, const std::array<int, 4>& order) { return g.add(op::Permute{order}, {x}); }
/// The same elements in the same order.
inline Tensor reshape(Graph& g, Tensor x, const Shape& shape) { return g.add(op::Reshape{}, {x}, shape); }
/// All tokens of all views as one sequence: [d, n, n_view] -> [d, n * n_view].
Tensor flatten_views(Graph& g, Tensor x);
/// Prepends the same tokens to the tokens of every view: tokens [d, n_first], x [d, n, n_view] -> [d, n_first + n,
/// n_view].
Tensor prepend_tokens(Graph& g, Tensor tokens, Tensor x);
/// Sets all features but the first `count` to zero: [d, n] -> the same shape.
Tensor zero_features_after(Graph& g, Tensor x, int count);
/// Flattens a matrix column by column: [d, n] -> [d * n, 1].
Tensor flatten(Graph& g, Tensor x);
/// Reshapes to tokens of another width: [d_x, n, n_view] -> [d, n * d_x / d, n_view].
Tensor reshape_width(Graph& g, Tensor x, std::int64_t d);
/// Squares of `factor` x `factor` patches become one token: [d, side^2, n_view] -> [d * factor^2, (side / factor)^2,
/// n_view]. Within a token the patches follow each other row by row. Source: transformers modeling_smolvlm.py
/// pixel_shuffle.
Tensor pixel_shuffle(Graph& g, Tensor x, int factor);
/// The same for patches in rows of `n_column`: [d, n, n_view] -> [d * factor^2, n / factor^2, n_view].
inline Tensor pixel_shuffle(Graph& g, Tensor x, int n_column, int factor) {
  return g.add(op::PixelShuffle{n_column, factor}, {x});
}

}  // namespace vla
