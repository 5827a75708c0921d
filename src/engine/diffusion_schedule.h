// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "bundle/keys.h"

namespace vla {

/// The update rule of a diffusers scheduler, from x at one time to x at the next. Let `other` = (x - p answer) q.
///   If the network predicts noise, the sample is `other`, clipped, and the noise is the answer.
///   If the network predicts the sample, the sample is the answer, clipped, and the noise is `other`.
///   ddpm  x <- of_sample sample + of_rest x + of_drawn drawn
///   ddim  x <- of_sample sample + of_rest noise
struct DiffusionSchedule {
  struct Step {
    int time;  // the training timestep that the network receives
    float p, q, of_sample, of_rest, of_drawn;
  };
  bool predicts_noise = false, draws = false;  // draws: whether steps add new noise (ddpm)
  float clip = 0;                              // limit of a sample's magnitude; 0: no clipping
  std::vector<Step> steps;

  /// Reads `solver.n_train_step`, `.beta_schedule`, `.beta_start`, `.beta_end`, `.predicts` and `.clip`. Every number
  /// is float32 and rounded where the reference rounds it. Errors: bad_bundle. Source: diffusers
  /// schedulers/scheduling_ddpm.py, scheduling_ddim.py (`leading` timesteps, `fixed_small` variance, eta 0).
  static Result<DiffusionSchedule> read(const Keys& keys, bool draws, int n_step);
};

}  // namespace vla
