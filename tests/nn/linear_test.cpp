// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Layers through the kernels of this machine against plain ggml operations on the same bundle.
#include "nn/linear.h"

#include <doctest/doctest.h>

#include <cmath>

#include "kernels/kernel_set.h"
#include "nn/norm.h"
#include "nn/tokens.h"
#include "support/graph_runner.h"
#include "support/param_set.h"

namespace linear_test {

using namespace vla;
using test::ramp;

namespace {

constexpr int kModel = 35, kFf = 67;
constexpr int kFew = 13, kMany = 70;  // rows: where bf16 is multiplied, x of few is taken more exactly

/// Layers `a` and `b` of kModel to kFf and `c` back, with biases and weights in a storage type.
std::vector<test::ParamSet::Piece> make_pieces(DType type) {
  std::vector<test::ParamSet::Piece> pieces;
  for (const char* name : {"a", "b", "c"}) {
    const std::int64_t d_in = *name == 'c' ? kFf : kModel, d_out = *name == 'c' ? kModel : kFf;
    const float range = 0.2f + 0.1f * static_cast<float>(*name - 'a');
    pieces.push_back(
        {std::string(name) + ".weight", {d_in, d_out}, ramp(static_cast<std::size_t>(d_in * d_out), range), type});
    pieces.push_back({std::string(name) + ".bias", {d_out}, ramp(static_cast<std::size_t>(d_out), 1.0f)});
  }
  return pieces;
}

struct Layers {
  Linear a, b, c;
  explicit Layers(const Scope& s)
      : a(s / "a", kModel, kFf, Bias::yes), b(s / "b", kModel, kFf, Bias::yes), c(s / "c", kFf, kModel, Bias::yes) {}
};

Tensor gated(Graph& g, const Layers& l, Tensor x) {
  return multiply(g, activate(g, l.a(g, x), Activation::silu), l.b(g, x));
}

/// What `build` makes of x [kModel, n_row]; the value under the path `tap` is kept beside it.
std::vector<float> run(const std::string& kernels, DType type, int n_row, const std::string& tap,
                       const std::function<Tensor(Graph&, const Layers&, Tensor)>& build) {
  test::ParamSet params(make_pieces(type));
  const Layers layers(params.scope());
  test::GraphRunner runner(
      params.list(), kernels, [&](const std::string& path) { return path == "result" || path == tap; }, 3);
  Graph& g = runner.graph;
  const Tensor x = g.input(runner.slot(ramp(static_cast<std::size_t>(kModel * n_row), 1.0f), {kModel, n_row, 1, 1}));
  g.name("result", build(g, layers, x));
  runner.lower();
  runner.run();
  return runner.tap("result");
}

/// Every kernel of this machine and every storage type against widened weights and ggml; sums of at most 67 products
/// of numbers below 1 differ by their order alone.
void check_like_ggml(const std::function<Tensor(Graph&, const Layers&, Tensor)>& build) {
  for (DType type : {DType::bf16, DType::f16, DType::f32})
    for (int n_row : {kFew, kMany}) {
      const std::vector<float> expected = run("ggml", type, n_row, "", build);
      for (const KernelSet& set : usable_kernels())
        for (const char* tap : {"", "a", "c"}) {
          CAPTURE(name_of(set));
          CAPTURE(dtype_name(type));
          CAPTURE(n_row);
          CAPTURE(tap);
          const std::vector<float> got = run(name_of(set), type, n_row, tap, build);
          // Some round x to bf16: 2^-9 of each product, or 2^-17 for few rows.
          const bool rounds = type == DType::bf16 && rounds_to_bf16(set);
          const double tolerance = !rounds ? 1e-5 : n_row == kMany ? 0.1 : 4e-4;
          double largest = 0;
          REQUIRE(got.size() == expected.size());
          for (std::size_t i = 0; i < got.size(); ++i)
            largest = std::max(largest, std::abs(double{got[i]} - expected[i]));
          CHECK(largest <= tolerance);
        }
    }
}

}  // namespace

TEST_CASE("a layer gives what ggml's product of widened weights gives") {
  check_like_ggml([](Graph& g, const Layers& l, Tensor x) { return l.c(g, l.a(g, x)); });
}

TEST_CASE("an activation and a residual behind the product give what they give alone, with a tap between them too") {
  check_like_ggml([](Graph& g, const Layers& l, Tensor x) {
    return add(g, x,
               l.c(g, activate(g, l.b(g, l.c(g, activate(g, l.a(g, x), Activation::gelu_tanh))), Activation::silu)));
  });
}

TEST_CASE("tokens cut out of several sequences are multiplied and added to as any x is") {
  check_like_ggml([](Graph& g, const Layers& l, Tensor x) {
    const int half = static_cast<int>(x.dim(1)) / 2;
    const Tensor two = g.add(op::Reshape{}, {slice_tokens(g, x, 0, 2 * half)}, {kModel, half, 2, 1});
    const Tensor some = slice_tokens(g, two, 1, half - 1);
    return add(g, some, l.c(g, activate(g, l.a(g, some), Activation::gelu_erf)));
  });
}

TEST_CASE("a gated product gives what its operations give alone, with a tap of the gate too") {
  check_like_ggml([](Graph& g, const Layers& l, Tensor x) { return l.c(g, gated(g, l, x)); });
}

TEST_CASE("layers of one x give what each gives alone") {
  check_like_ggml([](Graph& g, const Layers& l, Tensor x) {
    const Tensor a = l.a(g, x), b = l.b(g, x);
    return l.c(g, add(g, scale(g, a, -1), b));
  });
}

Tensor normed(Graph& g, Tensor x, bool centred) {
  const Tensor weight = test::constant(g, ramp(kModel, 2), {kModel});
  if (!centred) return g.add(op::Norm{op::NormKind::rms, 1e-5f}, {x, weight});
  return g.add(op::Norm{op::NormKind::layer, 1e-5f}, {x, weight, test::constant(g, ramp(kModel, 1), {kModel})});
}

TEST_CASE("a norm before products gives what the norm and the products give one after the other") {
  for (bool centred : {false, true})
    check_like_ggml([&](Graph& g, const Layers& l, Tensor x) {
      const Tensor h = normed(g, x, centred);
      return l.c(g, gated(g, l, h));
    });
}

}  // namespace linear_test
