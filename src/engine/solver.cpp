// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "engine/solver.h"

#include <algorithm>
#include <numeric>

#include "nn/tokens.h"

namespace vla {
namespace {

Status expect(bool holds, const char* key, const char* expected, const std::string& found) {
  if (holds) return {};
  return Error{Code::bad_bundle, key, expected, found, "this bundle needs a newer vla, or was not made by vla-convert"};
}

/// min(max(x, -limit), limit).
Tensor clipped(Graph& g, Tensor x, float limit) {
  const Tensor most = full(g, limit, 1, 1), least = full(g, -limit, 1, 1);
  const Tensor above = add(g, activate(g, add(g, x, most), Activation::relu), least);
  const Tensor room = activate(g, add(g, scale(g, above, -1), most), Activation::relu);
  return add(g, scale(g, room, -1), most);
}

}  // namespace

Result<Solver> Solver::read(const Keys& keys) {
  Solver solver;
  VLA_TRY(const std::string kind, keys.string("solver.kind"));
  const bool denoises = kind == "ddpm" || kind == "ddim";
  solver.direct = kind == "direct", solver.renoises = kind == "renoise", solver.decodes = kind == "greedy";
  VLA_CHECK(expect(
      denoises || solver.direct || solver.renoises || solver.decodes || kind == "euler" || kind == "euler_float32",
      "solver.kind", "euler, euler_float32, direct, renoise, ddpm, ddim or greedy", kind));
  VLA_TRY(solver.n_step, keys.integer("solver.steps", {1, solver.direct ? 1.0 : 1000.0}));
  VLA_TRY(solver.noise, keys.string("solver.noise"));
  if (solver.direct || solver.decodes) {
    VLA_CHECK(expect(solver.noise == "none", "solver.noise", "none", solver.noise));
    if (solver.decodes) {
      VLA_TRY(solver.stop_token, keys.integer("solver.stop_token", {0, 1 << 24}));
    }
    solver.times.push_back({0.0f, 0.0});
    return solver;
  }
  VLA_CHECK(
      expect(solver.noise == "normal" || solver.noise == "uniform", "solver.noise", "normal or uniform", solver.noise));
  if (denoises) {
    VLA_TRY(solver.diffusion, DiffusionSchedule::read(keys, kind == "ddpm", solver.n_step));
    for (const DiffusionSchedule::Step& step : solver.diffusion->steps)
      solver.times.push_back({static_cast<float>(step.time), static_cast<double>(step.time)});
    return solver;
  }
  if (solver.renoises) {
    for (int k = solver.n_step; k > 0; --k) {
      const double time = static_cast<double>(k) / solver.n_step;
      solver.times.push_back({static_cast<float>(time), time});
    }
    return solver;
  }
  VLA_TRY(const double start, keys.number("solver.t_start", {0, 1}));
  VLA_TRY(const double end, keys.number("solver.t_end", {0, 1}));
  const double dt = (end - start) / solver.n_step;
  solver.t_end = end;
  solver.dt = static_cast<float>(dt);
  float accumulated = static_cast<float>(start);
  for (int k = 0; k < solver.n_step; ++k, accumulated += solver.dt)
    solver.times.push_back({kind == "euler" ? static_cast<float>(start + k * dt) : accumulated,
                            start + (end - start) * k / solver.n_step});
  return solver;
}

Tensor Solver::next(Graph& g, Tensor x, Tensor answer, Tensor act_noise, Tensor k) const {
  if (diffusion) return denoised(g, x, answer, act_noise, k);
  if (renoises) return blend(g, answer, reshape(g, act_noise, x.shape()), k);
  return direct ? answer : add(g, x, scale(g, answer, dt));
}

Tensor Solver::after(Graph& g, Tensor k) const {
  const Tensor table = g.constant_ids("next step", [n = n_step] {
    std::vector<std::int32_t> next(static_cast<std::size_t>(n));
    std::iota(next.begin(), next.end() - 1, 1);  // 0 after the last step
    return next;
  });
  return column(g, g.add(op::Reshape{}, {table}, {1, n_step, 1, 1}), k);
}

/// Step k adds column k + 1 of the noise; column 0 is the start. The last step has the factor 0 for noise.
Tensor Solver::denoised(Graph& g, Tensor x, Tensor answer, Tensor act_noise, Tensor k) const {
  using Step = DiffusionSchedule::Step;
  const auto& steps = diffusion->steps;
  const auto factor = [&](float Step::*number) {
    std::vector<float> values;
    for (const Step& step : steps) values.push_back(step.*number);
    return column(g, g.constant(values, {1, n_step, 1, 1}), k);
  };
  const Tensor other = multiply(g, add(g, x, scale(g, multiply(g, answer, factor(&Step::p)), -1)), factor(&Step::q));
  Tensor sample = diffusion->predicts_noise ? other : answer;
  if (diffusion->clip > 0) sample = clipped(g, sample, diffusion->clip);
  const Tensor predicted_noise = diffusion->predicts_noise ? answer : other;
  const Tensor rest = diffusion->draws ? x : predicted_noise;
  Tensor next = add(g, multiply(g, sample, factor(&Step::of_sample)), multiply(g, rest, factor(&Step::of_rest)));
  if (n_noise() == 1) return next;
  const Tensor drawn = reshape(g, column(g, act_noise, after(g, k)), x.shape());
  return add(g, next, multiply(g, drawn, factor(&Step::of_drawn)));
}

/// t * start + (1 - t) * answer, where t is the time of the step after step k, or 0 after the last step.
Tensor Solver::blend(Graph& g, Tensor answer, Tensor start, Tensor k) const {
  std::vector<float> shares;
  for (int next = 1; next <= n_step; ++next) {
    const float time = next < n_step ? times[static_cast<std::size_t>(next)].value : 0.0f;
    shares.insert(shares.end(), {time, 1.0f - time});
  }
  const Tensor share = column(g, g.constant(shares, {2, n_step, 1, 1}), k);
  const Tensor of_start = multiply(g, start, slice_features(g, share, 0, 1));
  return add(g, of_start, multiply(g, answer, slice_features(g, share, 1, 1)));
}

}  // namespace vla
