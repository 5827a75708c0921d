// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Norms between bf16 products on our own kernels for CUDA, through the fake driver (see lowering_test.cpp).
#include "lower/lower_case.h"

namespace norm_lowering_test {

using namespace vla;
using namespace vla::test;

namespace {

constexpr int kRows = 20;

struct Norm {
  op::NormKind kind = op::NormKind::rms;
  bool has_bias = false;
};

Tensor first_product(GraphRunner& r, const LowerParams& p, int n_row = kRows) {
  return p.linear(r.graph, input(r, {24, n_row, 1, 1}), 24);
}
Tensor normed(GraphRunner& r, const LowerParams& p, Tensor x, const Norm& norm = {}) {
  std::vector<Tensor> in = {x, p.parameter(r.graph, 24)};
  if (norm.has_bias) in.push_back(p.parameter(r.graph, 24));
  return r.graph.add(op::Norm{norm.kind, 1e-5f}, in);
}
/// The sum of two products of x.
Tensor two_products(GraphRunner& r, const LowerParams& p, Tensor x) {
  return add(r.graph, p.linear(r.graph, x, 48), p.linear(r.graph, p.linear(r.graph, x, 24, true, 1), 48));
}

int count_of(const std::string& text, const std::string& part) {
  int n = 0;
  for (std::size_t at = text.find(part); at != text.npos; at = text.find(part, at + 1)) ++n;
  return n;
}

/// Checks how many norms of the graph `build` products begin, and how many are operations, and the graph's result.
void check(const Build& build, int n_begun, int n_operation) {
  const LowerParams params(DType::bf16);
  GraphRunner runner(params.list(), "");
  runner.graph.name("result", build(runner, params));
  const std::string text = runner.lower().text();
  CAPTURE(text);
  CHECK(count_of(text, ", begins norm") == n_begun);
  CHECK(count_of(text, "  norm, round") == n_operation);
  runner.run();
  check_close(runner.tap("result"), result_of("float32", params, build), 1e-2);
}

}  // namespace

TEST_CASE("a product begins the norm that only bf16 products read, and those end it") {
  for (const int n_row : {kRows, 60})
    for (const Norm& norm : {Norm{op::NormKind::layer}, Norm{op::NormKind::layer, true}, Norm{op::NormKind::rms, true}})
      check([=](GraphRunner& r,
                const LowerParams& p) { return two_products(r, p, normed(r, p, first_product(r, p, n_row), norm)); },
            1, 0);
  check(
      [](GraphRunner& r, const LowerParams& p) {  // without parameters
        return two_products(r, p, r.graph.add(op::Norm{op::NormKind::layer, 1e-5f}, {first_product(r, p)}));
      },
      1, 0);
  check([](GraphRunner& r, const LowerParams& p) { return two_products(r, p, normed(r, p, first_product(r, p))); }, 1,
        0);
  check(
      [](GraphRunner& r, const LowerParams& p) {  // as in a layer: the sum is read again after the norm's products
        const Tensor x = add(r.graph, first_product(r, p), input(r, {24, kRows, 1, 1}));
        const Tensor up = p.linear(r.graph, normed(r, p, x), 48);
        return add(r.graph, x, p.linear(r.graph, up, 24));
      },
      1, 0);
  check(
      [](GraphRunner& r, const LowerParams& p) {  // one norm of two begins in the product
        const Tensor x = first_product(r, p);
        const Tensor other = r.graph.add(op::Norm{op::NormKind::rms, 1e-2f}, {x});
        return add(r.graph, p.linear(r.graph, normed(r, p, x), 48),
                   activate(r.graph, p.linear(r.graph, other, 48), Activation::silu));
      },
      1, 1);
}

TEST_CASE("ways to lower a graph that VLA_CUDA_WITHOUT names are not used, and the device says so") {
  const auto build = [](GraphRunner& r, const LowerParams& p) {
    const Tensor x = add(r.graph, first_product(r, p), input(r, {24, kRows, 1, 1}));
    return two_products(r, p, normed(r, p, x));
  };
  const LowerParams params(DType::bf16);
  for (const auto& [without, name] : {std::pair{"", ""},
                                      {"clusters", ", without clusters"},
                                      {"rotations,halved-norms", ", without halved-norms, rotations"}}) {
    REQUIRE(setenv("VLA_CUDA_WITHOUT", without, 1) == 0);
    const bool is_halved = std::string(name).find("halved") == std::string::npos;
    check(build, is_halved ? 1 : 0, is_halved ? 0 : 1);
    CHECK(GraphRunner(params.list(), "").device().name() == "cuda:0, a GPU of tests" + std::string(name));
  }
  REQUIRE(setenv("VLA_CUDA_WITHOUT", "clusters,rotation", 1) == 0);
  const auto opened = open_device(1, "");
  REQUIRE(unsetenv("VLA_CUDA_WITHOUT") == 0);
  REQUIRE(!opened.ok());
  CHECK(
      opened.error().message() ==
      "VLA_CUDA_WITHOUT: expected names of clusters, adders, halved-norms, rotations, with commas between them, found "
      "rotation");
}

TEST_CASE("a norm that a product's kernels cannot begin, or its readers not end, is an operation") {
  check(
      [](GraphRunner& r, const LowerParams& p) {  // rows, and those of a weight and a bias, of more than a block
        return two_products(r, p, normed(r, p, first_product(r, p, 61), {op::NormKind::layer, true}));
      },
      0, 1);
  check(
      [](GraphRunner& r, const LowerParams& p) {  // of a product with an activation
        return two_products(r, p, normed(r, p, activate(r.graph, first_product(r, p), Activation::silu)));
      },
      0, 1);
  check(
      [](GraphRunner& r, const LowerParams& p) {  // of no product
        return two_products(r, p, normed(r, p, input(r, {24, kRows, 1, 1})));
      },
      0, 1);
  check(
      [](GraphRunner& r, const LowerParams& p) {  // with a weight that is made after the product
        const Tensor x = first_product(r, p), weight = reshape(r.graph, slice(r.graph, x, 1, 3, 1), {24, 1, 1, 1});
        return two_products(r, p, r.graph.add(op::Norm{op::NormKind::rms, 1e-5f}, {x, scale(r.graph, weight, 2)}));
      },
      0, 1);
  check(
      [](GraphRunner& r, const LowerParams& p) {  // with such a bias
        const Tensor x = first_product(r, p), bias = reshape(r.graph, slice(r.graph, x, 1, 3, 1), {24, 1, 1, 1});
        const std::vector<Tensor> in = {x, p.parameter(r.graph, 24), scale(r.graph, bias, 2)};
        return two_products(r, p, r.graph.add(op::Norm{op::NormKind::rms, 1e-5f}, in));
      },
      0, 1);
}

}  // namespace norm_lowering_test
