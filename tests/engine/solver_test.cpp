// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "engine/solver.h"

#include "nn/embedding.h"
#include "support/graph_runner.h"

using namespace vla;

namespace {

Result<Solver> read(const std::string& kind, int steps, const std::string& noise = "normal") {
  Keys keys;
  keys.set("solver.kind", kind);
  keys.set("solver.steps", std::int64_t{steps});
  keys.set("solver.t_start", 1.0);
  keys.set("solver.t_end", 0.0);
  keys.set("solver.noise", noise);
  return Solver::read(keys);
}

}  // namespace

TEST_CASE("euler rounds each time once, and euler_float32 adds the rounded step up as openpi's loop does") {
  const auto exact = read("euler", 10), accumulated = read("euler_float32", 10);
  REQUIRE((exact.ok() && accumulated.ok()));
  CHECK(exact->times[2].value == 0.8F);
  CHECK(exact->times[9].value == 0.1F);
  CHECK(accumulated->times[1].value == 0.9F);
  CHECK(accumulated->times[2].value == 0.79999995F);  // torch: t = tensor(1.0); t += tensor(-0.1), twice
  CHECK(accumulated->times[9].value == 0.09999993F);
  CHECK(exact->dt == accumulated->dt);
  CHECK(exact->times.size() == 10);
  CHECK(exact->times[3].exact == doctest::Approx(0.7).epsilon(1e-15));
  CHECK(accumulated->times[3].exact == exact->times[3].exact);
}

TEST_CASE("another kind of solver is refused with those that there are") {
  const auto refused = read("heun", 10);
  REQUIRE_FALSE(refused.ok());
  CHECK(refused.error().code == Code::bad_bundle);
  CHECK(refused.error().message().find("euler, euler_float32, direct or renoise, found heun") != std::string::npos);
}

TEST_CASE("a solver that renoises mixes the answer with the start again, less of it at every step") {
  const auto solver = read("renoise", 4);
  REQUIRE(solver.ok());
  CHECK(solver->renoises);
  std::vector<float> times;
  for (const SolverTime& time : solver->times) times.push_back(time.value);
  CHECK(times == std::vector<float>{1.0F, 0.75F, 0.5F, 0.25F});
  const auto next = [&](int k) {
    return test::run_graph([&](Graph& g) {
      const Tensor x = test::constant(g, {7, 7}, {2, 1}), answer = test::constant(g, {4, -8}, {2, 1});
      return solver->next(g, x, answer, test::constant(g, {16, 32}, {2, 1}), constant_ids(g, "k", {k}));
    });
  };
  CHECK(next(0) == std::vector<float>{13, 22});
  CHECK(next(2) == std::vector<float>{7, 2});
  CHECK(next(3) == std::vector<float>{4, -8});
}

TEST_CASE("a direct head answers the chunk in one pass, from no noise") {
  const auto solver = read("direct", 1, "none");
  REQUIRE(solver.ok());
  CHECK(solver->direct);
  CHECK(solver->times.size() == 1);
  const auto answer = [](const Solver& s) {
    return test::run_graph([&](Graph& g) {
      return s.next(g, test::constant(g, {1, 2, 3, 4}, {2, 2}), test::constant(g, {5, 6, 7, 8}, {2, 2}));
    });
  };
  CHECK(answer(*solver) == std::vector<float>{5, 6, 7, 8});
  CHECK(answer(*read("euler", 2)) == std::vector<float>{-1.5F, -1, -0.5F, 0});
  const auto many = read("direct", 2, "none"), noisy = read("direct", 1, "normal");
  REQUIRE_FALSE((many.ok() || noisy.ok()));
  CHECK(many.error().message().find("solver.steps") != std::string::npos);
  CHECK(noisy.error().message().find("solver.noise") != std::string::npos);
}
