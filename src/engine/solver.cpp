// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "engine/solver.h"

#include "nn/tokens.h"

namespace vla {
namespace {

Status expect(bool holds, const char* key, const char* expected, const std::string& found) {
  if (holds) return {};
  return Error{Code::bad_bundle, key, expected, found, "this bundle needs a newer vla, or was not made by vla-convert"};
}

}  // namespace

Result<Solver> Solver::read(const Keys& keys) {
  Solver solver;
  VLA_TRY(const std::string kind, keys.string("solver.kind"));
  VLA_CHECK(expect(kind == "euler" || kind == "euler_float32" || kind == "direct" || kind == "renoise", "solver.kind",
                   "euler, euler_float32, direct or renoise", kind));
  solver.direct = kind == "direct", solver.renoises = kind == "renoise";
  VLA_TRY(solver.n_step, keys.integer("solver.steps", {1, solver.direct ? 1.0 : 1000.0}));
  VLA_TRY(solver.noise, keys.string("solver.noise"));
  if (solver.direct) {
    VLA_CHECK(expect(solver.noise == "none", "solver.noise", "none", solver.noise));
    solver.times.push_back({0.0f, 0.0});
    return solver;
  }
  VLA_CHECK(
      expect(solver.noise == "normal" || solver.noise == "uniform", "solver.noise", "normal or uniform", solver.noise));
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

Tensor Solver::next(Graph& g, Tensor x, Tensor answer, Tensor start, Tensor k) const {
  if (renoises) return blend(g, answer, start, k);
  return direct ? answer : add(g, x, scale(g, answer, dt));
}

/// The time of the step after step k; 0 after the last.
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
