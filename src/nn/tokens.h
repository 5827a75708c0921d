// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <initializer_list>
#include <vector>

#include "backend/graph.h"

namespace vla {

/// Sequences one after the other, in every view: [d, n_1, n_view], [d, n_2, n_view], ... -> [d, n_1 + n_2 + ...,
/// n_view].
Tensor concat_tokens(Graph& g, std::initializer_list<Tensor> parts);
Tensor concat_tokens(Graph& g, const std::vector<Tensor>& parts);
/// Ids first to first + count - 1, without a copy: [n] i32 -> [count].
Tensor slice_ids(Graph& g, Tensor ids, int first, int count);
/// Keys or values first to first + count - 1, without a copy: [d_head, n_head, n] -> [d_head, n_head, count].
Tensor slice_keys(Graph& g, Tensor x, int first, int count);
/// Keys or values one after the other: [d_head, n_head, n_1], [d_head, n_head, n_2] -> [d_head, n_head, n_1 + n_2].
Tensor append_keys(Graph& g, Tensor past, Tensor present);
/// Two feature vectors per token, the first above the second: [d_1, n], [d_2, n] -> [d_1 + d_2, n].
Tensor concat_features(Graph& g, Tensor first, Tensor second);
/// Tokens first to first + count - 1, of every view, without a copy: [d, n, n_view] -> [d, count, n_view].
Tensor slice_tokens(Graph& g, Tensor x, int first, int count);
/// A constant: [d, n] of the same number.
Tensor filled(Graph& g, float value, std::int64_t d, std::int64_t n);
/// One vector for every token of `like`: [d, 1] -> [d, n].
Tensor repeat_like(Graph& g, Tensor x, Tensor like);

/// One column of a table, chosen at run time: [d, n], index [1] i32 -> [d, 1].
Tensor column(Graph& g, Tensor table, Tensor index);

Tensor add(Graph& g, Tensor a, Tensor b);
Tensor scale(Graph& g, Tensor x, float factor);
/// Every token times the same vector, number by number, or every number of a token times the token's own: x [d, n,
/// ...], factor [d] or [1, n] -> the shape of x.
Tensor multiply(Graph& g, Tensor x, Tensor factor);
/// All tokens of all views as one sequence: [d, n, n_view] -> [d, n * n_view].
Tensor flatten_views(Graph& g, Tensor x);
/// One view's tokens, without a copy: [d, n, n_view] -> [d, n].
Tensor one_view(Graph& g, Tensor x, int view);
/// A token in front of every view's: token [d], x [d, n, n_view] -> [d, 1 + n, n_view].
Tensor prepend_token(Graph& g, Tensor token, Tensor x);
/// x with zeros in all features but the first `count`: [d, n] -> the same shape.
Tensor first_features(Graph& g, Tensor x, int count);
/// The columns of a matrix below each other, without a copy: [d, n] -> [d * n, 1].
Tensor one_column(Graph& g, Tensor x);
/// The same numbers as tokens of another width, without a copy: [d_x, n, n_view] -> [d, n * d_x / d, n_view].
Tensor columns(Graph& g, Tensor x, std::int64_t d);
/// Squares of `factor` x `factor` patches become one token: [d, side^2, n_view] -> [d * factor^2, (side / factor)^2,
/// n_view]. Within a token the patches follow each other row by row. Source: transformers modeling_smolvlm.py
/// pixel_shuffle.
Tensor pixel_shuffle(Graph& g, Tensor x, int factor);
/// The same for patches in rows of `n_column`: [d, n, n_view] -> [d * factor^2, n / factor^2, n_view].
Tensor pixel_shuffle(Graph& g, Tensor x, int n_column, int factor);

}  // namespace vla
