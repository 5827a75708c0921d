// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "nn/module.h"

namespace vla {

/// (x - mean) / sqrt(variance + eps) * weight + bias, with mean and variance over a group of features at all places of
/// a view. x [d, width, height, n_view] -> the same shape. Source: torch.nn.GroupNorm.
class GroupNorm : public Module<GroupNorm> {
 public:
  GroupNorm(const Scope& s, int d, int n_group, float eps);
  Tensor forward(Graph& g, Tensor x) const;

 private:
  int n_group_;
  const Param *weight_, *bias_;
  float eps_;
};

}  // namespace vla
