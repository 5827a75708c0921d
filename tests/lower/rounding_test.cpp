// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Matrices of floats that are rounded when they are loaded, because somebody asked for it.
#include "graph/rounding.h"
#include "kernels/kernel_set.h"
#include "nn/linear.h"
#include "nn/tokens.h"
#include "support/graph_runner.h"
#include "support/param_set.h"

namespace rounding_test {

using namespace vla;
using namespace vla::test;

namespace {

constexpr int kWide = 300, kNarrow = 160, kAction = 32;

/// Numbers that f16 and float32 hold alike.
ParamSet::Piece piece(const std::string& name, const std::vector<std::int64_t>& shape, DType type = DType::bf16) {
  std::int64_t count = 1;
  for (const std::int64_t n : shape) count *= n;
  std::vector<float> values = ramp(static_cast<std::size_t>(count), 0.1f);
  store_as(DType::f16, values);
  return {name, shape, std::move(values), type};
}
std::vector<ParamSet::Piece> pieces(DType type, DType small) {
  return {piece("up.weight", {kNarrow, kWide}, type),        piece("up.bias", {kWide}, DType::f32),
          piece("down.weight", {kWide, kNarrow}, type),      piece("down.bias", {kNarrow}, DType::f32),
          piece("action.weight", {kNarrow, kAction}, small), piece("action.bias", {kAction}, DType::f32)};
}

struct Parameters {
  Parameters(DType type, DType small) : set(pieces(type, small)) {}

  ParamSet set;
  Linear up{set.scope("up"), kNarrow, kWide, Bias::yes}, down{set.scope("down"), kWide, kNarrow, Bias::yes},
      action{set.scope("action"), kNarrow, kAction, Bias::yes};
};

/// An MLP with its norm and its residual, and a small product.
std::vector<float> mlp(const std::string& kernels, DType type, DType small) {
  Parameters params(type, small);
  return run_graph(
      params.set.list(),
      [&](Graph& g) {
        const Tensor x = constant(g, ramp(kNarrow * 37, 2.0f), {kNarrow, 37});
        const Tensor h =
            g.add(op::Norm{op::NormKind::rms, 1e-5f}, {x, constant(g, std::vector<float>(kNarrow, 1), {kNarrow})});
        const Tensor y = add(g, x, params.down(g, activate(g, params.up(g, h), Activation::gelu_tanh)));
        return concat(g, {y, params.action(g, x)}, 0);
      },
      kernels);
}

std::vector<float> mlp(const std::string& kernels, DType type) { return mlp(kernels, type, type); }

}  // namespace

TEST_CASE("large products are near those of float32, whatever the weights are stored as, and small ones the same") {
  for (const DType type : {DType::bf16, DType::f16, DType::f32}) {
    CAPTURE(dtype_name(type));
    const std::vector<float> expected = mlp("float32", type), same = mlp("", type), got = mlp("int8", type);
    constexpr std::size_t kRow = kNarrow + kAction;
    double error = 0, size = 0;
    for (std::size_t i = 0; i < got.size(); ++i) {
      if (i % kRow >= kNarrow) {
        CHECK(got[i] == same[i]);
      } else {
        error += std::pow(got[i] - expected[i], 2);
        size += std::pow(expected[i], 2);
      }
    }
    CHECK(std::sqrt(error / size) < 0.02);
    CHECK(std::sqrt(error / size) > 1e-4);  // something was quantized
  }
}

TEST_CASE("what was quantized is told, and takes a byte for each number") {
  Parameters params(DType::bf16, DType::bf16);
  GraphRunner floats(params.set.list(), ""), quantized(params.set.list(), "int8");
  CHECK(quantized.device().precision() == Precision::int8);
  CHECK(quantized.device().kernels() == floats.device().kernels());
  CHECK(quantized.device().linear_kernels().find("_int8 (2 bf16)") != std::string::npos);
  CHECK(quantized.device().weights_size() < 0.7 * static_cast<double>(floats.device().weights_size()));
}

TEST_CASE("a policy with nothing to round is refused, before any memory is taken") {
  struct {
    std::string kernels, verb;
    DType small;
  } const cases[] = {{"int8", "quantizing", DType::bf16}, {"bf16", "rounding", DType::f32}};
  for (const auto& [kernels, verb, small] : cases) {
    if (std::string(kernels) == "bf16" && !rounds_to_bf16(usable_kernels().back())) continue;
    ParamSet set({piece("action.weight", {kNarrow, kAction}, small), piece("action.bias", {kAction}, DType::f32)});
    const Linear action(set.scope("action"), kNarrow, kAction, Bias::yes);
    const auto device = open_device(1, kernels);
    REQUIRE(device.ok());
    const Status loaded = (*device)->load(set.list(), true);
    REQUIRE(!loaded.ok());
    CHECK(loaded.error().code == Code::unsupported);
    CHECK(loaded.error().message().find("kernels " + kernels) != std::string::npos);
    CHECK(loaded.error().message().find(verb) != std::string::npos);
    CHECK((*device)->weights_size() == 0);
  }
}

TEST_CASE("large matrices rounded to bf16 are those of a bundle that stores them so, and small ones stay" *
          doctest::skip(!rounds_to_bf16(usable_kernels().back()))) {
  for (const DType type : {DType::f32, DType::f16}) {
    CAPTURE(dtype_name(type));
    CHECK(mlp("bf16", type) == mlp("", DType::bf16, type));
    CHECK(mlp("", type) != mlp("bf16", type));
  }
  Parameters params(DType::f32, DType::f32);
  GraphRunner floats(params.set.list(), ""), rounded(params.set.list(), "bf16");
  CHECK(floats.device().precision() == Precision::f32);
  CHECK(rounded.device().precision() == Precision::bf16);
  CHECK(rounded.device().linear_kernels().find(rounded.device().kernels() + " (2 f32)") != std::string::npos);
  CHECK(rounded.device().weights_size() < 0.6 * static_cast<double>(floats.device().weights_size()));
}

TEST_CASE("other devices take no int8") {
  const auto device = open_device(1, "int8", "vulkan");
  REQUIRE(!device.ok());
  CHECK(device.error().code == Code::usage);
}

}  // namespace rounding_test
