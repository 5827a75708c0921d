// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "bundle/keys.h"
#include "engine/diffusion_schedule.h"
#include "graph/graph.h"
#include "modules/timestep_embedding.h"

namespace vla {

/// The solver as data: the times at which the action head is evaluated, and the update rule.
///   euler, euler_float32  x <- x + dt * velocity(x, t_k), with equal steps from t_start to t_end
///   direct                one pass: x <- the network's answer, from a start of zeros
///   ddpm, ddim            the diffusers scheduler of this name (engine/diffusion_schedule.h); ddpm adds noise in every
///                         step but the last
///   greedy                decodes tokens one by one, each the most likely next token, until the stop token or `steps`
///                         tokens
///   renoise               the network predicts actions: x <- t * start + (1 - t) * actions, where t is the next step's
///                         time, from 1 to 0 (lerobot policies/xvla/modeling_xvla.py generate_actions)
struct Solver {
  int n_step = 0;
  bool direct = false, renoises = false;
  bool decodes = false;          // `greedy`
  std::int32_t stop_token = -1;  // ends the answer of `greedy`
  double t_end = 0;
  float dt = 0;  // (t_end - t_start) / n_step, computed in double and rounded once, as in the reference
  /// t_k; t_end is never evaluated. `euler`: t_start + k * dt in double, rounded once, as in LeRobot. `euler_float32`:
  /// dt added k times in float32, as in openpi. They differ by 1e-7, which changes a sine with a period of 4e-3 by one
  /// part in 1e4.
  std::vector<SolverTime> times;
  std::string noise;  // kind of the noise, at the start and in steps: normal, uniform or none
  std::optional<DiffusionSchedule> diffusion;

  /// Chunks of noise in an act: the start, then one for each step that adds noise.
  int n_noise() const { return diffusion && diffusion->draws ? n_step : 1; }
  /// Whether a step depends on its index k.
  bool counts() const { return renoises || decodes || diffusion.has_value(); }
  /// Runs of the step's graph in an act, at most: the first token comes from the prefix.
  int n_run() const { return decodes ? n_step - 1 : n_step; }
  /// Whether steps read the act's noise.
  bool rereads_noise() const { return renoises || n_noise() > 1; }

  /// Reads `solver.*`. Errors: bad_bundle. Source: lerobot policies/common/flow_matching.py euler_integrate, openpi
  /// models_pytorch/pi0_pytorch.py sample_actions.
  static Result<Solver> read(const Keys& keys);

  /// Records a step: x and the network's answer, both [d_action, horizon] -> the next x. `act_noise` [d_action *
  /// horizon, n_noise], the act's noise, is needed if `rereads_noise()`; `k` [1] i32, the step's index, if `counts()`.
  Tensor next(Graph& g, Tensor x, Tensor answer, Tensor act_noise = {}, Tensor k = {}) const;
  /// The step after step k [1] i32, and 0 after the last.
  Tensor after(Graph& g, Tensor k) const;

 private:
  Tensor blend(Graph& g, Tensor answer, Tensor start, Tensor k) const;
  Tensor denoised(Graph& g, Tensor x, Tensor answer, Tensor act_noise, Tensor k) const;
};

}  // namespace vla
