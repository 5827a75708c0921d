// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Work is counted from shapes alone, so that no graph here is run.
#include "graph/work.h"

#include "kernels/kernel_set.h"
#include "support/graph_runner.h"
#include "support/param_set.h"

namespace work_test {

using namespace vla;
using test::GraphRunner;
using test::ParamSet;

namespace {

/// A matrix [64, 5] in a dtype.
std::vector<ParamSet::Piece> matrix(DType type) { return {{"w", {64, 5}, test::ramp(64 * 5, 1), type}}; }

std::vector<std::string> own_kernels() {
  std::vector<std::string> names;
  for (const KernelSet& set : usable_kernels())
    if (!(set == kernel_set::ggml)) names.push_back(name_of(set));
  return names;
}

}  // namespace

TEST_CASE("a product counts two operations for each multiply-add, and attention two products with every key") {
  Slots slots;
  Graph g(slots);
  const Param weight = {.name = "w", .shape = {8, 5}};
  const Tensor x = g.input(slots.add_f32({8, 3, 2, 1}));
  CHECK(flop_of(*g.add(op::Linear{&weight, nullptr}, {x}).node()) == 2.0 * 8 * 5 * 3 * 2);
  const Tensor q = g.input(slots.add_f32({4, 6, 3, 2})), k = g.input(slots.add_f32({4, 2, 7, 2})),
               more = g.input(slots.add_f32({4, 2, 1, 2})), mask = g.input(slots.add_f32({8, 3, 1, 1}));
  CHECK(flop_of(*g.add(op::Attention{true}, {q, mask, k, k, more, more}).node()) == 2.0 * 2 * 4 * 6 * 3 * 2 * 8);
  CHECK(flop_of(*g.add(op::Add{}, {x, x}).node()) == 0);
}

TEST_CASE("stored bytes count in their dtype, so that a bf16 weight moves half of a float32 one") {
  for (const std::string& kernels : own_kernels())
    for (const auto& [type, size] : {std::pair(DType::bf16, 2.0), std::pair(DType::f32, 4.0)}) {
      ParamSet params(matrix(type));
      const Param* w = params.scope().matrix("w", 64, 5);
      GraphRunner runner(params.list(), kernels);
      Graph& g = runner.graph;
      g.name("result", g.add(op::Linear{w, nullptr}, {g.input(runner.slot(test::ramp(64 * 3, 1), {64, 3, 1, 1}))}));
      const std::vector<Work> work = runner.lower().work();
      REQUIRE(work.size() == 1);
      CHECK(work[0].flop == 2.0 * 64 * 5 * 3);
      CHECK(work[0].bytes == size * 64 * 5 + 4.0 * (64 * 3 + 5 * 3));
    }
}

TEST_CASE("looking up rows moves those rows and not the table, and a view moves nothing") {
  for (const std::string& kernels : own_kernels()) {
    GraphRunner runner(ParamList(Keys(), nullptr), kernels);
    Graph& g = runner.graph;
    const Tensor table = g.input(runner.slot(test::ramp(16 * 1000, 1), {16, 1000, 1, 1}));
    const Tensor rows = g.add(op::Gather{}, {table, g.constant_ids("ids", [] {
                                               return std::vector<std::int32_t>{7, 0, 999};
                                             })});
    g.name("result", g.add(op::Reshape{}, {rows}, {8, 6, 1, 1}));
    const std::vector<Work> work = runner.lower().work();
    CHECK(work[0].flop == 0);
    CHECK(work[0].bytes == 4.0 * (3 + 2 * 3 * 16));
  }
}

TEST_CASE("a program splits its work and its times at the graph's stages, and leaves out what stays the same") {
  for (const KernelSet& set : usable_kernels()) {
    CAPTURE(name_of(set));
    ParamSet params(matrix(DType::f32));
    const Param* w = params.scope().matrix("w", 64, 5);
    GraphRunner runner(params.list(), name_of(set));
    Graph& g = runner.graph;
    const Slot *x = runner.slot(test::ramp(64 * 3, 1), {64, 3, 1, 1}),
               *same = runner.slot(test::ramp(64, 1), {64, 1, 1, 1});
    const auto product = [&](Tensor in) { return g.add(op::Linear{w, nullptr}, {in}); };
    const Tensor first = product(g.input(x)), kept = product(g.input(same));
    g.end_stage("first");
    const Tensor both = g.add(op::Add{}, {g.add(op::Add{}, {first, kept}), product(g.add(op::Scale{2}, {g.input(x)}))});
    g.name("result", both);
    Program& program = runner.lower({{x}});
    const std::vector<Work> work = program.work();
    REQUIRE(work.size() == 2);
    CHECK(work[0].flop == 2.0 * 64 * 5 * (set == kernel_set::ggml ? 4 : 3));
    CHECK(work[1].flop == 2.0 * 64 * 5 * 3);
    REQUIRE(program.stages().size() == 1);
    CHECK(program.stages()[0].name == "first");
    const auto before = std::chrono::steady_clock::now();
    runner.run();
    CHECK(program.stages()[0].done >= before);
    CHECK(program.stages()[0].done <= std::chrono::steady_clock::now());
  }
}

}  // namespace work_test
