// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Work is counted from shapes alone, so that no graph here is run.
#include "backend/work.h"

#include <doctest/doctest.h>
#include <ggml.h>

#include "backend/graph.h"

using namespace vla;

namespace {

/// A graph without weights.
struct Fixture {
  Device device = std::move(*Device::cpu(1, "ggml"));
  ParamList none{Keys(), nullptr};
  Weights weights = std::move(*Weights::load(none, device, Weights::Fill::no));
  Store store{16};
  Graph graph{weights, store, {}};
};

}  // namespace

TEST_CASE("a product counts two operations for each multiply-add, and each operand once") {
  Fixture f;
  const Tensor w = f.store.add_f32({8, 5}), x = f.store.add_f32({8, 3, 2});
  const Work work = work_of(ggml_mul_mat(f.graph.context(), w.node(), x.node()));
  CHECK(work.flop == 2.0 * 8 * 5 * 3 * 2);
  CHECK(work.bytes == 4.0 * (8 * 5 + 8 * 3 * 2 + 5 * 3 * 2));
}

TEST_CASE("stored bytes count in their dtype, so that a bf16 weight moves half of a float32 one") {
  Fixture f;
  const std::int64_t shape[] = {64, 5};
  const Tensor w = f.store.add(GGML_TYPE_BF16, shape), x = f.store.add_f32({64, 3});
  CHECK(work_of(ggml_mul_mat(f.graph.context(), w.node(), x.node())).bytes == 2.0 * 64 * 5 + 4.0 * (64 * 3 + 5 * 3));
}

TEST_CASE("looking up rows moves those rows and not the table, and a view moves nothing") {
  Fixture f;
  ggml_context* c = f.graph.context();
  const Tensor table = f.store.add_f32({16, 1000}), ids = f.store.add_i32({3});
  const Work rows = work_of(ggml_get_rows(c, table.node(), ids.node()));
  CHECK(rows.flop == 0);
  CHECK(rows.bytes == 4.0 * (3 + 2 * 3 * 16));
  CHECK(work_of(ggml_reshape_2d(c, table.node(), 8, 2000)).bytes == 0);
  CHECK(work_of(ggml_cpy(c, table.node(), f.store.add_f32({16, 1000}).node())).bytes == 4.0 * 2 * 16 * 1000);
}

TEST_CASE("a graph splits its work at its stages, and a note stands in for what shapes do not tell") {
  Fixture f;
  ggml_context* c = f.graph.context();
  const Tensor w = f.store.add_f32({8, 8}), x = f.store.add_f32({8, 3});
  const Tensor first = f.graph.stage("first", ggml_mul_mat(c, w.node(), x.node()));
  const Tensor second = ggml_scale(c, first.node(), 2);
  f.graph.note_work(second, {1000, 10});
  f.graph.require(second);
  const std::vector<Work> parts = f.graph.work();
  REQUIRE(parts.size() == 2);
  CHECK(parts[0].flop == 2.0 * 8 * 8 * 3);
  CHECK(parts[1].flop == 1000);
  CHECK(parts[1].bytes == 10);
}
