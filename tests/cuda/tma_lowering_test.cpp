// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Products whose operands TMA fetches, through the fake driver (see lowering_test.cpp).
#include "lower/lower_case.h"

namespace tma_lowering_test {

using namespace vla;
using namespace vla::test;

namespace {

constexpr int kRows = 380, kDepth = 64, kColumns = 1024;  // two rows of tiles on each of 16 SMs

std::vector<ParamSet::Piece> pieces() {
  const auto n = static_cast<std::size_t>(kDepth * kColumns);
  return {{"plain", {kDepth, kColumns}, ramp(n, 0.1f), DType::bf16},
          {"gate", {kDepth, kColumns / 2}, ramp(n / 2, 0.12f), DType::bf16},
          {"up", {kDepth, kColumns / 2}, ramp(n / 2, 0.14f), DType::bf16}};
}

/// The result, and the program's text, of a product of each kind.
std::pair<std::vector<float>, std::string> run(const std::string& kernels) {
  ParamSet set(pieces());
  const Scope s = set.scope();
  const Param* plain = s.matrix("plain", kDepth, kColumns);
  const Param *gate = s.matrix("gate", kDepth, kColumns / 2), *up = s.matrix("up", kDepth, kColumns / 2);
  GraphRunner r(set.list(), kernels);
  Graph& g = r.graph;
  const Tensor x = input(r, {kDepth, kRows, 1, 1});
  const auto linear = [&](const Param* matrix) { return g.add(op::Linear{matrix, nullptr}, {x}); };
  const Tensor gated = multiply(g, activate(g, linear(gate), Activation::silu), linear(up));
  g.name("result", concat(g, {linear(plain), gated}, 0));
  const std::string text = r.lower().text();
  r.run();
  return {r.tap("result"), text};
}

}  // namespace

TEST_CASE("with VLA_CUDA_WITH=tma TMA fetches what products of many rows multiply, and the device says so") {
  const auto [expected, text] = run("");
  CHECK(text.find("hopper_tma") == text.npos);
  REQUIRE(setenv("VLA_CUDA_WITH", "tma", 1) == 0);
  const auto [found, text_of_tma] = run("");
  const auto name = open_device(1, "");
  REQUIRE(setenv("VLA_CUDA_WITH", "TMA", 1) == 0);
  const auto unknown = open_device(1, "");
  REQUIRE(unsetenv("VLA_CUDA_WITH") == 0);
  CAPTURE(text_of_tma);
  CHECK(text_of_tma.find("hopper_tma_bf16_128x192 ") != text.npos);
  CHECK(text_of_tma.find("hopper_tma_bf16_128x192_gated") != text.npos);
  CHECK(found == expected);
  check_close(found, run("float32").first, 1e-2);
  REQUIRE(name.ok());
  CHECK((*name)->name() == "cuda:0, a GPU of tests, with tma");
  REQUIRE(!unknown.ok());
  CHECK(unknown.error().message() ==
        "VLA_CUDA_WITH: expected names of flash, tma, with commas between them, found TMA");
}

}  // namespace tma_lowering_test
