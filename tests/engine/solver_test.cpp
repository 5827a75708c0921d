// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "engine/solver.h"

#include <cmath>

#include "nn/embedding.h"
#include "support/graph_runner.h"

namespace solver_test {

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
  CHECK(refused.error().message().find("euler, euler_float32, direct, renoise, ddpm, ddim or greedy, found heun") !=
        std::string::npos);
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

namespace {

/// A scheduler of diffusers: what its step makes of x = (0.5, -2) and an answer (0.3, 1) where it draws (0.25, -1.5).
struct Scheduled {
  std::string kind, betas, predicts;
  double clip;
  int n_train, n_step;
  struct Step {
    int k, time;
    std::vector<float> next;
  };
  std::vector<Step> steps;
};

Keys keys_of(const Scheduled& of) {
  return Keys({{"solver.kind", of.kind},
               {"solver.steps", std::int64_t{of.n_step}},
               {"solver.noise", "normal"},
               {"solver.n_train_step", std::int64_t{of.n_train}},
               {"solver.beta_schedule", of.betas},
               {"solver.beta_start", 0.001},
               {"solver.beta_end", 0.05},
               {"solver.predicts", of.predicts},
               {"solver.clip", of.clip}});
}

// Numbers of diffusers 0.35.1.
const Scheduled kScheduled[] = {
    {"ddpm",
     "squaredcos_cap_v2",
     "noise",
     1,
     100,
     10,
     {{0, 90, {0.664794922F, -2.39522028F}}, {5, 40, {0.536852181F, -2.05243683F}}, {9, 0, {0.492617995F, -1.0F}}}},
    {"ddpm",
     "linear",
     "sample",
     0,
     50,
     7,
     {{0, 42, {0.541844487F, -1.75708044F}}, {3, 21, {0.456811428F, -0.796481252F}}, {6, 0, {0.300000012F, 1.0F}}}},
    {"ddpm",
     "scaled_linear",
     "noise",
     0,
     20,
     20,
     {{0, 19, {0.539010048F, -2.45825815F}},
      {10, 9, {0.513241291F, -2.23691702F}},
      {19, 0, {0.490758657F, -2.03263903F}}}},
    {"ddpm",
     "sigmoid",
     "sample",
     0.5,
     30,
     4,
     {{0, 21, {0.41735208F, -0.545160532F}}, {2, 7, {0.323945493F, 0.252898455F}}, {3, 0, {0.300000012F, 0.5F}}}},
    {"ddim",
     "squaredcos_cap_v2",
     "noise",
     1,
     100,
     10,
     {{0, 90, {0.578742146F, 0.664681673F}}, {5, 40, {0.494543642F, -0.404388189F}}, {9, 0, {0.492617995F, -1.0F}}}},
    {"ddim",
     "linear",
     "sample",
     0,
     50,
     7,
     {{0, 42, {0.494402856F, -1.62081361F}}, {3, 21, {0.450079083F, -1.10537076F}}, {6, 0, {0.300000012F, 1.0F}}}},
    {"ddim",
     "scaled_linear",
     "noise",
     0,
     20,
     20,
     {{0, 19, {0.499036074F, -2.09846735F}},
      {10, 9, {0.494384557F, -2.04657221F}},
      {19, 0, {0.490758657F, -2.03263903F}}}}};

}  // namespace

TEST_CASE("steps of ddpm and ddim are those of diffusers' schedulers") {
  for (const Scheduled& of : kScheduled) {
    CAPTURE(of.kind);
    CAPTURE(of.betas);
    const auto solver = Solver::read(keys_of(of));
    REQUIRE_MESSAGE(solver.ok(), (solver ? "" : solver.error().message()));
    CHECK(solver->n_noise() == (of.kind == "ddpm" ? of.n_step : 1));
    for (const Scheduled::Step& step : of.steps) {
      CHECK(solver->times[static_cast<std::size_t>(step.k)].value == static_cast<float>(step.time));
      // Every step but this one's draws something else; the start comes first.
      std::vector<float> noise(2 * static_cast<std::size_t>(of.n_step), 9.0F);
      if (step.k + 1 < of.n_step)
        noise[2 * static_cast<std::size_t>(step.k) + 2] = 0.25F,
                                                     noise[2 * static_cast<std::size_t>(step.k) + 3] = -1.5F;
      const auto next = test::run_graph([&](Graph& g) {
        const Tensor x = test::constant(g, {0.5F, -2}, {2, 1}), answer = test::constant(g, {0.3F, 1}, {2, 1});
        return solver->next(g, x, answer, test::constant(g, noise, {2, of.n_step}), constant_ids(g, "k", {step.k}));
      });
      for (std::size_t i = 0; i < 2; ++i) CHECK(std::abs(next[i] - step.next[i]) <= 5e-7F);
    }
  }
}

TEST_CASE("a scheduler is refused where it has no such betas, more steps than were trained, or no finite step") {
  const auto refused = [](const char* key, const Value& value, const char* kind = "ddpm") {
    Scheduled of = kScheduled[0];
    of.kind = kind;
    Keys keys = keys_of(of);
    keys.set(key, value);
    const auto solver = Solver::read(keys);
    REQUIRE_FALSE(solver.ok());
    CHECK(solver.error().code == Code::bad_bundle);
    return solver.error().message();
  };
  const auto tells = [](const std::string& message, const char* part) {
    return message.find(part) != std::string::npos;
  };
  CHECK(tells(refused("solver.beta_schedule", std::string("cosine")), "squaredcos_cap_v2 or sigmoid, found cosine"));
  CHECK(tells(refused("solver.beta_schedule", std::string("sigmoid"), "ddim"), "or squaredcos_cap_v2, found sigmoid"));
  CHECK(tells(refused("solver.predicts", std::string("velocity")), "noise or sample, found velocity"));
  CHECK(tells(refused("solver.steps", std::int64_t{101}), "at most the 100 of solver.n_train_step"));
  CHECK(tells(refused("solver.clip", -1.0), "solver.clip"));
  Keys keys = keys_of(kScheduled[1]);
  keys.set("solver.beta_start", 0.0), keys.set("solver.beta_end", 0.0);
  CHECK(tells(Solver::read(keys).error().message(), "no finite step"));
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

}  // namespace solver_test
