// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

#include "bundle/keys.h"

namespace vla {

/// Euler's rule with equal steps from t_start to t_end: x <- x + dt * velocity(x, t_k).
struct Solver {
  int n_step = 0;
  float dt = 0;  // (t_end - t_start) / n_step, made in double and rounded once, as the reference scales by it
  /// t_k; t_end is never evaluated. `euler`: t_start + k * dt, made in double and rounded once, as LeRobot.
  /// `euler_float32`: dt added k times in float32, as openpi; of a sine with a period of 4e-3 the 1e-7 between them is
  /// a part in 1e4.
  std::vector<float> times;
  std::string noise;  // kind of the starting noise

  /// Reads `solver.*`. Errors: bad_bundle. Source: lerobot policies/common/flow_matching.py euler_integrate, openpi
  /// models_pytorch/pi0_pytorch.py sample_actions.
  static Result<Solver> read(const Keys& keys);
};

}  // namespace vla
