// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "engine/solver.h"

#include <doctest/doctest.h>

using namespace vla;

namespace {

Result<Solver> read(const std::string& kind, int steps) {
  Keys keys;
  keys.set("solver.kind", kind);
  keys.set("solver.steps", std::int64_t{steps});
  keys.set("solver.t_start", 1.0);
  keys.set("solver.t_end", 0.0);
  keys.set("solver.noise", std::string("normal"));
  return Solver::read(keys);
}

}  // namespace

TEST_CASE("euler rounds each time once, and euler_float32 adds the rounded step up as openpi's loop does") {
  const auto exact = read("euler", 10), accumulated = read("euler_float32", 10);
  REQUIRE((exact.ok() && accumulated.ok()));
  CHECK(exact->times[2] == 0.8F);
  CHECK(exact->times[9] == 0.1F);
  CHECK(accumulated->times[1] == 0.9F);
  CHECK(accumulated->times[2] == 0.79999995F);  // torch: t = tensor(1.0); t += tensor(-0.1), twice
  CHECK(accumulated->times[9] == 0.09999993F);
  CHECK(exact->dt == accumulated->dt);
  CHECK(exact->times.size() == 10);
}

TEST_CASE("another kind of solver is refused with those that there are") {
  const auto refused = read("heun", 10);
  REQUIRE_FALSE(refused.ok());
  CHECK(refused.error().code == Code::bad_bundle);
  CHECK(refused.error().message().find("euler or euler_float32, found heun") != std::string::npos);
}
