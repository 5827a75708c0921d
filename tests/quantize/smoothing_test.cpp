// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Channels that are divided where they come from and multiplied where they are read.
#include "quantize/smoothing.h"

#include <doctest/doctest.h>

#include <algorithm>

#include "quantize/ones.h"
#include "quantize/smoothing_places.h"
#include "support/editable_bundle.h"
#include "support/golden_case.h"

namespace smoothing_test {

using namespace vla;
using namespace vla::test;

namespace {

constexpr int kWidth = 8;

/// Graphs over a norm, an MLP and what may read them.
struct Places {
  Places() {
    const Scope s = set.scope();
    norm = s.vector("norm", kWidth), bias = s.vector("bias", kWidth);
    for (const char* name : {"a", "b", "gate", "up", "down"}) matrices[name] = s.matrix(name, kWidth, kWidth);
    x = g.input(slots.add_f32({kWidth, 4, 1, 1}));
  }
  Tensor normed() {
    return g.name("n", g.add(op::Norm{op::NormKind::layer, 1e-5f}, {x, g.parameter(norm), g.parameter(bias)}));
  }
  Tensor product(const char* matrix, Tensor of, const Param* with = nullptr) {
    return g.add(op::Linear{matrices.at(matrix), with}, {of});
  }
  std::vector<std::string> paths() {
    SmoothingPlaces finder;
    finder.see(g);
    std::vector<std::string> paths;
    for (const SmoothingPlace& place : finder.found()) paths.push_back(place.path);
    return paths;
  }

  ParamSet set{ones(kWidth, {"a", "b", "gate", "up", "down"}, {"norm", "bias"})};
  const Param *norm, *bias;
  std::map<std::string, const Param*> matrices;
  Slots slots;
  Graph g{slots};
  Tensor x;
};

using Paths = std::vector<std::string>;

}  // namespace

TEST_CASE("a norm whose channels only matrices read may be smoothed, also through some of its tokens") {
  Places p;
  const Tensor n = p.normed();
  p.product("a", n);
  p.product("b", p.g.add(op::Slice{1, 2}, {n}, {kWidth, 2, 1, 1}));
  CHECK(p.paths() == Paths{"n"});
}

TEST_CASE("a norm that something else reads, or whose matrices or weights have other readers, may not") {
  SUBCASE("the result is added to") {
    Places p;
    const Tensor n = p.normed();
    p.g.add(op::Add{}, {p.product("a", n), n});
    CHECK(p.paths().empty());
  }
  SUBCASE("some of its channels are read") {
    Places p;
    const Tensor n = p.normed();
    p.product("a", n);
    p.g.add(op::Slice{0, 2}, {n}, {2, 4, 1, 1});
    CHECK(p.paths().empty());
  }
  SUBCASE("a matrix multiplies something else too") {
    Places p;
    p.product("a", p.normed());
    p.product("a", p.x);
    CHECK(p.paths().empty());
  }
  SUBCASE("its bias is another's") {
    Places p;
    p.product("a", p.normed(), p.bias);
    CHECK(p.paths().empty());
  }
  SUBCASE("nobody can tap it") {
    Places p;
    p.product("a", p.g.add(op::Norm{op::NormKind::rms, 1e-5f}, {p.x, p.g.parameter(p.norm)}));
    CHECK(p.paths().empty());
  }
}

TEST_CASE("a matrix that multiplies zeros too may read a norm that is smoothed, another constant it may not") {
  for (const float value : {0.0f, 1.0f}) {
    CAPTURE(value);
    Places p;
    p.product("a", p.normed());
    p.product("a", p.g.constant(std::vector<float>(kWidth, value), {kWidth, 1, 1, 1}));
    CHECK(p.paths() == (value == 0 ? Paths{"n"} : Paths()));
  }
}

TEST_CASE("rows of an MLP's up may be divided, and its columns multiplied") {
  Places p;
  const Tensor n = p.normed(), up = p.product("up", n);
  const Tensor gate = p.g.add(op::Activate{Activation::silu}, {p.product("gate", n)});
  p.product("down", p.g.name("h", p.g.add(op::Multiply{}, {gate, up})));
  CHECK(p.paths() == Paths{"h", "n"});
  p.product("a", up);
  CHECK(p.paths() == Paths{"n"});
}

TEST_CASE("a smoothed policy acts as before in float32, to the bit") {
  int n_smoothed = 0;
  for (const std::string& name : golden_paths()) {
    CAPTURE(name);
    const GoldenCase golden = GoldenCase::read(name);
    const std::string to = write_file("smoothed.gguf", "");
    const Judged seen = {golden.observation, golden.noise};
    const auto found = find_smoothing(golden.bundle(), std::span(&seen, 1), {.n_thread = 1, .all_robots = true});
    if (!found) {
      CHECK_MESSAGE(found.error().code == Code::unsupported, found.error().message());
      continue;
    }
    n_smoothed += !found->scalings.empty();
    REQUIRE(write_smoothed(golden.bundle(), to, found->scalings).ok());
    const auto before = load_engine(golden.bundle(), "", "float32"), after = load_engine(to, "", "float32");
    const auto expected = before->act(golden.observation, golden.noise);
    const auto got = after->act(golden.observation, golden.noise);
    REQUIRE(expected.ok());
    REQUIRE(got.ok());
    CHECK(got->actions == expected->actions);
  }
  CHECK(n_smoothed > 10);
}

TEST_CASE("norms that are computed at load are smoothed, by what they give at load") {
  const GoldenCase golden = GoldenCase::read(golden_path("turbovla/two_views"));
  SmoothingPlaces finder;
  std::map<std::string, std::size_t> seen;
  const std::string norm = "decoder.blk.0.attn_norm";
  const auto engine = Engine::load(
      golden.bundle(), {.kernels = "float32",
                        .tap_pattern = norm,
                        .see_graph = [&](const Graph& g) { finder.see(g); },
                        .see_tap = [&](const std::string& path, auto, auto values) { seen[path] += values.size(); }});
  REQUIRE(engine.ok());
  const std::vector<SmoothingPlace> places = finder.found();
  CHECK(std::ranges::count(places, norm, &SmoothingPlace::path) == 1);
  CHECK(seen[norm] > 0);
}

TEST_CASE("X-VLA's keys of zeros leave the norms of its windows to be smoothed") {
  SmoothingPlaces finder;
  const auto engine = Engine::load(golden_path("xvla/two_views/bundle.gguf"),
                                   {.dry = true, .see_graph = [&](const Graph& g) { finder.see(g); }});
  REQUIRE(engine.ok());
  const auto places = finder.found();
  CHECK(std::ranges::count_if(places, [](const SmoothingPlace& place) {
          return place.path.starts_with("vision.") && place.path.ends_with("spatial.attn_norm");
        }) > 0);
}

}  // namespace smoothing_test
