// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Which operations become one. Whether fused operations compute the same is for ops_test.cpp and place_test.cpp.
#include <sstream>

#include "lower/arithmetic.h"
#include "lower_case.h"
#include "support/kernel_rows.h"

namespace fuse_test {

using namespace vla;
using namespace vla::test;

namespace {

/// Lines of the program's text without columns of numbers.
std::vector<std::string> operations(const Build& build, const std::string& taps = "") {
  const LowerParams params;
  GraphRunner runner(params.list(), name_of(lowered_kernels().back()),
                     [&](const std::string& path) { return path == "result" || path == taps; });
  runner.graph.name("result", build(runner, params));
  const std::string text = runner.lower().text();
  std::vector<std::string> lines;
  for (std::size_t begin = 0; begin < text.size();) {
    const std::size_t end = text.find('\n', begin);
    lines.push_back(text.substr(begin, end - begin));
    begin = end + 1;
  }
  return lines;
}
std::size_t n_operation(const Build& build, const std::string& taps = "") { return operations(build, taps).size(); }

Tensor block(GraphRunner& r, const LowerParams& p) {
  Graph& g = r.graph;
  const Tensor x = input(r, {24, 5, 1, 1});
  const Tensor h = g.name("norm", g.add(op::Norm{op::NormKind::rms, 1e-5f}, {x, p.parameter(g, 24)}));
  const auto heads = [&](Tensor y) { return split_heads(g, y, 3); };
  const Tensor table = input(r, {8, 5, 1, 1});
  const auto rotate = [&](Tensor y) { return g.add(op::Rope{}, {y, table}); };
  const Tensor q = rotate(heads(g.name("q", p.linear(g, h, 24, true, 0)))),
               k = g.name("k", rotate(heads(p.linear(g, h, 24, true, 1)))), v = heads(p.linear(g, h, 48));
  const Tensor mixed = attention(g, q, {{k, slice(g, v, 0, 0, 8)}}, {});
  return add(g, x, g.name("out", p.linear(g, mixed, 24, true, 0)));
}

}  // namespace

#define VLA_FUSE_TEST(sentence) TEST_CASE(sentence* doctest::skip(lowered_kernels().empty()))

VLA_FUSE_TEST("activation, factor and residual are part of the product before them") {
  const auto lines = operations([](GraphRunner& r, const LowerParams& p) {
    Graph& g = r.graph;
    const Tensor x = input(r, {35, 5, 1, 1});
    const Tensor h = activate(g, p.linear(g, x, 35), Activation::silu);
    return add(g, x, multiply(g, h, p.parameter(g, 35)));
  });
  REQUIRE(lines.size() == 1);
  for (const char* word : {"linear", "silu", "factor", "residual"}) CHECK(lines[0].find(word) != std::string::npos);
}

VLA_FUSE_TEST("gate and up are one product, with the norm before them") {
  CHECK(n_operation([](GraphRunner& r, const LowerParams& p) {
          Graph& g = r.graph;
          const Tensor x = g.add(op::Norm{op::NormKind::layer, 1e-5f}, {input(r, {35, 5, 1, 1})});
          const Tensor up = p.linear(g, x, 67, true, 1);
          return multiply(g, activate(g, p.linear(g, x, 67, true, 0), Activation::gelu_tanh), up);
        }) == 1);
}

VLA_FUSE_TEST("a norm that somebody else reads is computed once, for itself") {
  CHECK(n_operation([](GraphRunner& r, const LowerParams& p) {
          Graph& g = r.graph;
          const Tensor x = g.add(op::Norm{op::NormKind::layer, 1e-5f}, {input(r, {35, 5, 1, 1})});
          return add(g, x, p.linear(g, x, 35));
        }) == 2);
}

VLA_FUSE_TEST("what two readers need is no part of either") {
  CHECK(n_operation([](GraphRunner& r, const LowerParams& p) {
          Graph& g = r.graph;
          const Tensor y = p.linear(g, input(r, {35, 5, 1, 1}), 35);
          return add(g, activate(g, y, Activation::silu), y);
        }) == 3);
}

VLA_FUSE_TEST("a block is its three products at once, packed keys, attention, and the product behind it") {
  CHECK(n_operation(block) == 4);
}

VLA_FUSE_TEST("a tap keeps its own value apart and nothing else") {
  CHECK(n_operation(block, "norm") == 5);  // the norm is no part of the products any more
  CHECK(n_operation(block, "k") == 5);     // the keys are rotated for themselves
  CHECK(n_operation(block, "q") == 4);     // a product's result, which stood in memory anyhow
  CHECK(n_operation(block, "out") == 5);   // the residual is added behind it
  CHECK(n_operation(block, "nobody") == 4);
}

VLA_FUSE_TEST("what nobody reads is not computed") {
  CHECK(n_operation([](GraphRunner& r, const LowerParams& p) {
          Graph& g = r.graph;
          const Tensor x = input(r, {35, 5, 1, 1});
          p.linear(g, x, 67);
          return p.linear(g, x, 35);
        }) == 1);
}

TEST_CASE("attention over few keys rounds nothing, and shares no packed keys with one that does" *
          doctest::skip(lacks(kernel_set::avx512_bf16))) {
  const LowerParams params(DType::bf16);
  GraphRunner runner(params.list(), "avx512_bf16");
  Graph& g = runner.graph;
  const int n = static_cast<int>(min_rounded_keys(params.list())) - 1;
  const Tensor q = input(runner, {8, 3, 2, 1}), k = input(runner, {8, 3, n, 1}), one = input(runner, {8, 3, 1, 1});
  g.name("result", add(g, attention(g, q, {{k, k}}, {}), attention(g, q, {{k, k}, {one, one}}, {})));
  const std::string text = runner.lower().text();
  CAPTURE(text);
  const auto n_line = [&](const std::string& kernel, const std::string& what) {
    std::istringstream lines(text);
    int n_found = 0;
    for (std::string line; std::getline(lines, line);) {
      std::istringstream words(line);
      std::string phase, name;
      words >> phase >> name;
      if (name == kernel && line.find(what) != std::string::npos) ++n_found;
    }
    return n_found;
  };
  CHECK(n_line("avx512", "attention") == 1);
  CHECK(n_line("avx512", "pack") == 1);
  CHECK(n_line("avx512_bf16", "attention") == 1);
  CHECK(n_line("avx512_bf16", "pack") == 2);
}

TEST_CASE("a product takes a window only where nobody else reads what it covers") {
  const LowerParams params;
  const auto text = [&](bool tapped, bool read_again) {
    GraphRunner r(params.list(), "portable");
    Graph& g = r.graph;
    Tensor x = g.add(op::Unfold{{2, 2, 0}}, {input(r, {8, 6, 4, 1})});
    if (tapped) x = g.name("result", x);
    Tensor y = activate(g, add(g, params.linear(g, x, 24), input(r, {24, 3, 2, 1})), Activation::relu);
    if (read_again) y = concat(g, {y, x}, 0);
    g.write(y, r.slot(std::vector<float>(static_cast<std::size_t>(count(y.shape()))), y.shape()));
    return r.lower().text();
  };
  CHECK(text(false, false).find("unfold, linear") != std::string::npos);
  CHECK(text(false, false).find("residual, relu") != std::string::npos);
  CHECK(text(true, false).find("unfold, linear") == std::string::npos);
  CHECK(text(false, true).find("unfold, linear") == std::string::npos);
}

}  // namespace fuse_test
