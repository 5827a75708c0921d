// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/compute_tokens.h"

#include <doctest/doctest.h>

#include <cmath>

#include "kernels/kernel_set.h"
#include "nn/attention.h"
#include "nn/linear.h"
#include "nn/norm.h"
#include "nn/rope.h"
#include "nn/tokens.h"
#include "support/graph_runner.h"
#include "support/param_set.h"

namespace compute_tokens_test {

using namespace vla;
using test::ramp;

namespace {

constexpr int kModel = 24, kHead = 8, kToken = 11, kFirst = 4, kCount = 3;

/// A layer as language models have it: grouped attention between rotated tokens, then a gated MLP.
struct Layer {
  RmsNorm norm;
  Linear q, k, v, out, gate, up, down;
  explicit Layer(const Scope& s)
      : norm(s / "norm", kModel, 1e-5f),
        q(s / "q", kModel, kModel, Bias::no),
        k(s / "k", kModel, kHead, Bias::yes),
        v(s / "v", kModel, kHead, Bias::no),
        out(s / "out", kModel, kModel, Bias::no),
        gate(s / "gate", kModel, 40, Bias::no),
        up(s / "up", kModel, 40, Bias::no),
        down(s / "down", 40, kModel, Bias::no) {}

  Tensor operator()(Graph& g, Tensor x, Tensor rotary, Tensor mask) const {
    const Tensor h = norm.forward(g, x);
    const auto heads = [&](Tensor y) { return split_heads(g, y, static_cast<int>(y.dim(0)) / kHead); };
    const Tensor mixed = attention(g, apply_rope(g, heads(q(g, h)), rotary),
                                   {{apply_rope(g, heads(k(g, h)), rotary), heads(v(g, h))}}, mask);
    x = add(g, x, out(g, mixed));
    const Tensor y = norm.forward(g, x);
    return add(g, x, down(g, multiply(g, silu(g, gate(g, y)), up(g, y))));
  }
};

std::vector<test::ParamSet::Piece> make_pieces() {
  std::vector<test::ParamSet::Piece> pieces = {{"norm.weight", {kModel}, ramp(kModel, 2.0f)},
                                               {"k.bias", {kHead}, ramp(kHead, 1.0f)}};
  float range = 0.3f;
  for (const auto& [name, d_in, d_out] : {std::tuple("q", kModel, kModel),
                                          {"k", kModel, kHead},
                                          {"v", kModel, kHead},
                                          {"out", kModel, kModel},
                                          {"gate", kModel, 40},
                                          {"up", kModel, 40},
                                          {"down", 40, kModel}})
    pieces.push_back(
        {std::string(name) + ".weight", {d_in, d_out}, ramp(static_cast<std::size_t>(d_in * d_out), range += 0.02f)});
  return pieces;
}

using Choose = Tensor (*)(Graph& g, Tensor y, int first, int count);

struct Outcome {
  std::vector<float> values;
  double flop;
};

/// Some tokens behind two layers; `tap` is recorded too.
Outcome run(Choose choose, const KernelSet& kernels, const std::string& tap = "") {
  test::ParamSet set(make_pieces());
  const Layer layer(set.scope());
  test::GraphRunner runner(set.list(), name_of(kernels),
                           [&](const std::string& path) { return path == "result" || path == tap; });
  Graph& g = runner.graph;
  const auto input = [&](const Shape& shape, float range) {
    return g.input(runner.slot(ramp(static_cast<std::size_t>(count(shape)), range), shape));
  };
  const Tensor rotary = input({kHead, kToken, 1, 1}, 1.0f), mask = input({kToken, kToken, 1, 1}, 3.0f);
  Tensor x = input({kModel, kToken, 1, 1}, 1.5f);
  x = g.name("first", layer(g, x, rotary, mask));
  x = g.name("second", layer(g, x, rotary, mask));
  g.name("result", choose(g, x, kFirst, kCount));
  double flop = 0;
  for (const Work& work : runner.lower().work()) flop += work.flop;
  runner.run();
  if (!tap.empty()) CHECK(runner.tap(tap).size() == kModel * kToken);
  return {runner.tap("result"), flop};
}

}  // namespace

TEST_CASE("tokens that are computed alone are those of all, from less work") {
  for (const KernelSet& set : usable_kernels()) {
    CAPTURE(name_of(set));
    const Outcome all = run(slice_tokens, set), some = run(compute_tokens, set);
    REQUIRE(some.values.size() == kModel * kCount);
    REQUIRE(all.values.size() == some.values.size());
    for (std::size_t i = 0; i < some.values.size(); ++i) CHECK(std::abs(some.values[i] - all.values[i]) <= 1e-5);
    // Of the second layer only keys and values are those of all tokens.
    const double matrices = 2.0 * kModel * (2 * kModel + 3 * 40), mixing = 4.0 * kModel * kToken;
    CHECK(all.flop - some.flop == doctest::Approx((kToken - kCount) * (matrices + mixing)));
  }
}

TEST_CASE("what is tapped is computed whole, once") {
  const KernelSet set = usable_kernels().back();
  for (const char* tap : {"first", "second"}) {
    CAPTURE(tap);
    const Outcome all = run(slice_tokens, set, tap), some = run(compute_tokens, set, tap);
    CHECK((some.flop < all.flop) == (std::string(tap) == "first"));
    CHECK(some.flop <= all.flop);
  }
}

}  // namespace compute_tokens_test
