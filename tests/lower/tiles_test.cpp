// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// How activations lie between products on a machine with AMX, or on one that is emulated (test_amx_machine).
#include "lower_case.h"
#include "support/kernel_rows.h"

using namespace vla;
using namespace vla::test;

TEST_CASE("amx: what products alone read stays in tiles between them, the last of uneven size" *
          doctest::skip(lacks(Isa::amx))) {
  const LowerParams params(DType::bf16);
  const auto run = [&](const char* kernels, int n_row) {
    GraphRunner runner(params.list(), kernels);
    Graph& g = runner.graph;
    const Tensor h = activate(g, params.linear(g, input(runner, {35, n_row, 1, 1}), 67), Activation::gelu_tanh);
    g.name("result", params.linear(g, h, 35));
    const std::string text = runner.lower().text();
    runner.run();
    return std::pair{text, runner.tap("result")};
  };
  CHECK(run("amx", 40).first.find("bf16 tiles [67, 40]") != std::string::npos);
  CHECK(run("amx", 16).first.find("tiles") == std::string::npos);  // few rows are not rounded
  check_close(run("amx", 40).second, run("ggml", 40).second, 0x1p-8);
}
