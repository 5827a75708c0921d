// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "nn/linear.h"

namespace vla {

/// Keypoints of a feature map. A linear map gives each cell `n_keypoint` scores; a keypoint is the mean position of the
/// cells, weighted by the softmax of its scores over all cells. The bundle states the cells' positions (`places`).
/// Source: lerobot policies/diffusion/modeling_diffusion.py SpatialSoftmax.
class SpatialSoftmax : public Module<SpatialSoftmax> {
 public:
  SpatialSoftmax(const Scope& s, int d_in, int n_cell, int n_keypoint);
  /// x [d_in, n_column, n_row, n_view] -> column, then row of each keypoint: [2 n_keypoint, n_view].
  Tensor forward(Graph& g, Tensor x) const;

 private:
  Linear map_;
  const Param* places_;  // column, then row of each cell
};

}  // namespace vla
