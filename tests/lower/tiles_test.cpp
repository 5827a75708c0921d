// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// How activations lie between products on a machine with AMX, or on one that is emulated (test_amx_machine).
#include <fmt/format.h>

#include "graph/rounding.h"
#include "lower_case.h"
#include "nn/linear.h"
#include "support/kernel_rows.h"

namespace tiles_test {

using namespace vla;
using namespace vla::test;

namespace {

/// Heads of 12 numbers, two of queries and one of keys and values, which are slices of one product.
Tensor attend(GraphRunner& r, const LowerParams& params) {
  Graph& g = r.graph;
  const Tensor x = input(r, {24, 130, 2, 1}), q = params.linear(g, x, 24), kv = params.linear(g, x, 24, true, 1);
  g.name("kv", kv);
  const Tensor k = split_heads(g, slice(g, kv, 0, 0, 12), 1), v = split_heads(g, slice(g, kv, 0, 12, 12), 1);
  const Tensor attended = attention(g, split_heads(g, q, 2), {{k, v}}, {});
  return params.linear(g, attended, 48);
}

void check_operands(const std::string& kernels, const std::string& rounded, const std::string& heads) {
  const LowerParams params(DType::bf16);
  const auto run = [&](const char* tapped) {
    GraphRunner runner(params.list(), kernels,
                       [=](const std::string& path) { return path == "result" || path == tapped; });
    runner.graph.name("result", attend(runner, params));
    const std::string text = runner.lower().text();
    runner.run();
    return std::pair{text, runner.tap("result")};
  };
  const auto [text, result] = run("");
  CHECK(text.find("-> " + rounded + ", " + rounded) != std::string::npos);
  CHECK(text.find("pack keys and values  " + heads) != std::string::npos);
  const auto [tapped_text, tapped] = run("kv");  // whoever looks on sees floats
  CHECK(tapped_text.find("-> " + rounded + ", f32[24, 130, 2]") != std::string::npos);
  CHECK(tapped == result);
}

}  // namespace

TEST_CASE("amx: queries, keys and values lie in tiles behind the product" * doctest::skip(lacks(kernel_set::amx))) {
  check_operands("amx", "bf16 tiles [24, 130, 2]", "bf16 tiles [12, 1, 130, 2]");
}
TEST_CASE("avx512_bf16: queries, keys and values are rounded by the product" *
          doctest::skip(lacks(kernel_set::avx512_bf16))) {
  check_operands("avx512_bf16", "bf16[24, 130, 2]", "bf16[12, 1, 130, 2]");
}

TEST_CASE("attention is computed in float32 where a matrix of float32 made its queries" *
          doctest::skip(!rounds_to_bf16(usable_kernels().back()))) {
  constexpr int kWidth = 64;
  const auto piece = [&](const char* name, DType type) {
    return ParamSet::Piece{std::string(name) + ".weight", {kWidth, kWidth}, ramp(kWidth * kWidth, 0.1f), type};
  };
  ParamSet set({piece("wide", DType::f32), piece("narrow", DType::bf16)});
  const Linear wide(set.scope("wide"), kWidth, kWidth, Bias::no), narrow(set.scope("narrow"), kWidth, kWidth, Bias::no);
  GraphRunner r(set.list(), "");
  Graph& g = r.graph;
  const Tensor x = input(r, {kWidth, 130, 1, 1});
  const auto attend_from = [&](const Linear& q) {
    const Tensor heads = split_heads(g, q(g, x), 2), keys = split_heads(g, narrow(g, x), 2);
    return attention(g, g.add(op::Rope{}, {heads, constant(g, ramp(32 * 130, 1), {32, 130})}), {{keys, keys}}, {});
  };
  const Tensor from_wide = attend_from(wide), from_narrow = attend_from(narrow);
  g.name("result", concat(g, {from_wide, from_narrow}, 0));
  const std::string text = r.lower().text(), best = name_of(usable_kernels().back());
  const auto kernel_of = [&](Tensor attended) {
    const std::size_t at = text.find(fmt::format("attention %{} ", attended.node()->id));
    REQUIRE(at != std::string::npos);
    const std::string line = text.substr(text.rfind('\n', at) + 1);
    return line.substr(5, line.find(' ', 5) - 5);
  };
  CHECK(kernel_of(from_wide) == "avx512");
  CHECK(kernel_of(from_narrow) == best);
}

TEST_CASE("amx: int8 products leave queries, keys and values in tiles too" * doctest::skip(lacks(kernel_set::amx))) {
  constexpr int kWidth = 160;
  std::vector<ParamSet::Piece> pieces;
  for (const char* name : {"q", "k", "v"})
    pieces.push_back({std::string(name) + ".weight", {kWidth, kWidth}, ramp(kWidth * kWidth, 0.1f), DType::bf16});
  ParamSet set(pieces);
  const auto linear = [&](const char* name) { return Linear(set.scope(name), kWidth, kWidth, Bias::no); };
  const Linear q = linear("q"), k = linear("k"), v = linear("v");
  const auto run = [&](const char* tapped) {
    GraphRunner r(set.list(), "int8", [=](const std::string& path) { return path == "result" || path == tapped; });
    Graph& g = r.graph;
    const Tensor x = input(r, {kWidth, 130, 1, 1}), keys = k(g, x);
    g.name("keys", keys);
    const Tensor attended =
        attention(g, split_heads(g, q(g, x), 4), {{split_heads(g, keys, 4), split_heads(g, v(g, x), 4)}}, {});
    g.name("result", attended);
    const std::string text = r.lower().text();
    r.run();
    return std::pair{text, r.tap("result")};
  };
  const auto [text, result] = run("");
  CHECK(text.find("pack keys and values  bf16 tiles [40, 4, 130]") != std::string::npos);
  CHECK(text.find("amx_int8") != std::string::npos);
  CHECK(run("keys").second == result);
}

TEST_CASE("amx: what products alone read stays in tiles between them, the last of uneven size" *
          doctest::skip(lacks(kernel_set::amx))) {
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

}  // namespace tiles_test
