// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <vector>

#include "backend/graph.h"
#include "kernels/linear_job.h"

namespace vla::kernels {

/// A matrix [d_in, d_out] and its bias [d_out], which may be null.
struct LinearTerm {
  const Param* weight;
  const Param* bias;
};

/// Who reads a result. Products that round their x round a hidden one no more, and it is stored as they want it.
enum class Readers { any, products };

/// activation(W x + bias) + residual in one node. x [d_in, n, ...] -> [d_out, n, ...], the shape of residual if any.
Tensor linear(Graph& g, const LinearTerm& term, Tensor x, Activation activation = Activation::none,
              Tensor residual = {}, Readers readers = Readers::any);

/// activation(gate(x)) * up(x) in one node. x [d_in, n, ...] -> [d_out, n, ...].
Tensor gated_linear(Graph& g, const LinearTerm& gate, const LinearTerm& up, Tensor x, Activation activation,
                    Readers readers = Readers::any);

/// What an activation is as a node of its own.
Tensor activate(Graph& g, Activation activation, Tensor x);

/// Up to three products of the same x in one node. x [d_in, n, ...] -> [d_out, n, ...] for each term, contiguous.
std::vector<Tensor> linear_group(Graph& g, std::span<const LinearTerm> terms, Tensor x);

}  // namespace vla::kernels
