// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "backend/graph.h"
#include "kernels/cpu_kernels.h"

namespace vla::kernels {

/// (x - mean) / sqrt(variance + eps) * weight + bias over the first dimension; weight and bias [d], the same for every
/// row. x [d, ...], rows of any strides -> the same shape.
Tensor layer_norm(Graph& g, Tensor x, Tensor weight, Tensor bias, float eps);

/// x / sqrt(mean(x^2) + eps) * weight + bias; without a bias none is added. An adaptive norm is this with weight
/// 1 + scale and bias shift.
Tensor rms_norm(Graph& g, Tensor x, Tensor weight, Tensor bias, float eps);

/// What a norm's node holds beside its sources, which are x, weight and, if there is one, bias.
struct NormParams {
  CpuKernels::Norm norm;
  float eps;
};

/// The norm whose result `x` is, or null. A product can then take the norm's own x, a row at a time; a norm that nobody
/// else reads never becomes part of the graph.
inline const NormParams* norm_of(const Graph& g, Tensor x) { return static_cast<const NormParams*>(g.noted(x)); }

}  // namespace vla::kernels
