// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "backend/graph.h"

namespace vla::kernels {

/// (x - mean) / sqrt(variance + eps) * weight + bias over the first dimension; weight and bias [d], the same for every
/// row. x [d, ...], rows of any strides -> the same shape.
Tensor layer_norm(Graph& g, Tensor x, Tensor weight, Tensor bias, float eps);

/// x / sqrt(mean(x^2) + eps) * weight + bias; without a bias none is added. An adaptive norm is this with weight
/// 1 + scale and bias shift.
Tensor rms_norm(Graph& g, Tensor x, Tensor weight, Tensor bias, float eps);

}  // namespace vla::kernels
