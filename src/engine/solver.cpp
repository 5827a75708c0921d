// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "engine/solver.h"

namespace vla {

Result<Solver> Solver::read(const Keys& keys) {
  VLA_TRY(const std::string kind, keys.string("solver.kind"));
  if (kind != "euler" && kind != "euler_float32")
    return Error{Code::bad_bundle, "solver.kind", "euler or euler_float32", kind, "this bundle needs a newer vla"};
  Solver solver;
  VLA_TRY(solver.n_step, keys.integer("solver.steps", {1, 1000}));
  VLA_TRY(const double start, keys.number("solver.t_start", {0, 1}));
  VLA_TRY(const double end, keys.number("solver.t_end", {0, 1}));
  VLA_TRY(solver.noise, keys.string("solver.noise"));
  if (solver.noise != "normal" && solver.noise != "uniform")
    return Error{Code::bad_bundle, "solver.noise", "normal or uniform", solver.noise};
  const double dt = (end - start) / solver.n_step;
  solver.dt = static_cast<float>(dt);
  float accumulated = static_cast<float>(start);
  for (int k = 0; k < solver.n_step; ++k, accumulated += solver.dt)
    solver.times.push_back(kind == "euler" ? static_cast<float>(start + k * dt) : accumulated);
  return solver;
}

}  // namespace vla
