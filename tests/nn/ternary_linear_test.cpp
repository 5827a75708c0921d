// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/linear.h"

#include <doctest/doctest.h>

#include <cmath>

#include "kernels/kernel_set.h"
#include "nn/norm.h"
#include "nn/tokens.h"
#include "support/graph_runner.h"
#include "support/param_set.h"

namespace ternary_linear_test {

using namespace vla;
using test::ramp;

namespace {

constexpr int kModel = 36, kFf = 68;

/// Weights -1, 0 and 1 in an order that repeats late.
std::vector<float> ternary(std::size_t count) {
  std::vector<float> values = ramp(count, 1.5f);
  for (float& value : values) value = std::nearbyint(value);
  return values;
}

void add_layer(std::vector<test::ParamSet::Piece>& pieces, const std::string& name, int d_in, int d_out, float scale) {
  pieces.push_back({name + ".weight", {d_in, d_out}, ternary(static_cast<std::size_t>(d_in * d_out)), DType::ternary});
  pieces.push_back({name + ".scale", {1}, {scale}});
  pieces.push_back({name + ".bias", {d_out}, ramp(static_cast<std::size_t>(d_out), 1.0f)});
}

std::vector<test::ParamSet::Piece> make_pieces() {
  std::vector<test::ParamSet::Piece> pieces;
  add_layer(pieces, "a", kModel, kFf, 0.11f);
  add_layer(pieces, "b", kModel, kFf, 0.07f);
  add_layer(pieces, "c", kFf, kModel, 0.05f);
  pieces.push_back({"norm.weight", {kModel}, ramp(kModel, 2.0f)});
  return pieces;
}

struct Layers {
  Linear a, b, c;
  RmsNorm norm;
  explicit Layers(const Scope& s)
      : a(s / "a", kModel, kFf, Bias::yes, Rule::int8_rows),
        b(s / "b", kModel, kFf, Bias::yes, Rule::int8_rows),
        c(s / "c", kFf, kModel, Bias::yes, Rule::int8_rows),
        norm(s / "norm", kModel, 1e-5f) {}
};

using Build = std::function<Tensor(Graph&, const Layers&, Tensor)>;

struct Outcome {
  std::vector<float> values;
  std::string text;
};

/// What `build` makes of x [kModel, n_row], the values of `tap`, and the program's text.
Outcome run(const std::string& kernels, int n_row, const Build& build, const std::string& tap = "result") {
  test::ParamSet params(make_pieces());
  const Layers layers(params.scope());
  test::GraphRunner runner(
      params.list(), kernels, [&](const std::string& path) { return path == tap; }, 3);
  Graph& g = runner.graph;
  std::vector<float> values = ramp(static_cast<std::size_t>(kModel * n_row), 1.0f);
  std::fill_n(values.begin(), kModel, 0.0f);  // a row of zeros
  g.name("result", build(g, layers, g.input(runner.slot(std::move(values), {kModel, n_row, 1, 1}))));
  const std::string text = runner.lower().text();
  runner.run();
  return {runner.tap(tap), text};
}

std::size_t n_line(const std::string& text, const std::string& word) {
  std::size_t n = 0;
  for (std::size_t at = text.find(word); at != std::string::npos; at = text.find(word, at + 1)) ++n;
  return n;
}

}  // namespace

TEST_CASE("a ternary product is the same to the bit on every choice of kernels, in float32 whole numbers too") {
  for (const int n_row : {1, 29, 70})
    for (const KernelSet& set : usable_kernels()) {
      const Build build = [](Graph& g, const Layers& l, Tensor x) {
        return add(g, l.c(g, scale(g, l.a(g, x), 0.5f)), x);
      };
      CAPTURE(name_of(set));
      CHECK(run(name_of(set), n_row, build).values == run("ggml", n_row, build).values);
    }
}

TEST_CASE("what follows a ternary product, and the norm before it, is fused and changes nothing but rounding") {
  const Build build = [](Graph& g, const Layers& l, Tensor x) {
    const Tensor h = l.norm(g, x);
    const Tensor mid = multiply(g, activate(g, l.a(g, h), Activation::relu_squared), l.b(g, h));
    return add(g, x, l.c(g, mid));
  };
  for (const KernelSet& set : usable_kernels()) {
    // A number that is rounded otherwise may become the next code: a 127th of the row's largest.
    const std::vector<float> expected = run("ggml", 70, build).values, got = run(name_of(set), 70, build).values;
    double error = 0, size = 0;
    for (std::size_t i = 0; i < got.size(); ++i)
      error += std::pow(double{got[i]} - expected[i], 2), size += std::pow(double{expected[i]}, 2);
    CHECK(std::sqrt(error / size) < 2e-3);
    if (set == kernel_set::ggml) continue;
    const std::string text = run(name_of(set), 70, build).text;
    CAPTURE(text);
    CHECK(n_line(text, "\n") == 4);  // quantize, gate and up, quantize, down
    CHECK(n_line(text, "norm, quantize") == 1);
    CHECK(n_line(text, "relu_squared, gate") == 1);
  }
}

TEST_CASE("products of one x read the same codes") {
  for (const KernelSet& set : usable_kernels()) {
    if (set == kernel_set::ggml) continue;
    const Outcome outcome = run(name_of(set), 40, [](Graph& g, const Layers& l, Tensor x) {
      const Tensor h = l.norm(g, x);
      return add(g, scale(g, l.a(g, h), 2), activate(g, l.b(g, h), Activation::silu));
    });
    CAPTURE(outcome.text);
    CHECK(n_line(outcome.text, "quantize") == 1);
    CHECK(n_line(outcome.text, "linear") == 2);
  }
}

TEST_CASE("a tapped norm is an operation of its own, which quantizing reads") {
  const Build build = [](Graph& g, const Layers& l, Tensor x) { return l.a(g, l.norm(g, x)); };
  for (const KernelSet& set : usable_kernels()) {
    const Outcome got = run(name_of(set), 40, build, "norm");
    const std::vector<float> expected = run("ggml", 40, build, "norm").values;
    for (std::size_t i = 0; i < expected.size(); ++i) CHECK(std::abs(got.values[i] - expected[i]) < 1e-6f);
    if (!(set == kernel_set::ggml)) CHECK(n_line(got.text, "norm, quantize") == 0);
  }
}

TEST_CASE("a ternary product whose rows are no whole bytes is refused") {
  ParamList list(Keys(), nullptr);
  const Linear layer(Scope(list, "odd"), 35, 8, Bias::no, Rule::int8_rows);
  const Status fits = list.report("test", {});
  REQUIRE_FALSE(fits.ok());
  CHECK(fits.error().message().find("odd.weight") != std::string::npos);
}

}  // namespace ternary_linear_test
