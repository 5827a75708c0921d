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
  std::vector<float> times;  // t_k = t_start + k * dt, made in double and rounded once; t_end is never evaluated
  std::string noise;         // kind of the starting noise

  /// Reads `solver.*`. Errors: bad_bundle. Source: lerobot policies/common/flow_matching.py euler_integrate.
  static Result<Solver> read(const Keys& keys);
};

}  // namespace vla
