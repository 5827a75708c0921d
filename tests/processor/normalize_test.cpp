// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/ops/normalize.h"

#include "processor/support.h"

namespace normalize_test {

using namespace vla;
using namespace vla::test;
using Direction = Normalizer::Direction;

namespace {

std::vector<float> floats(const nlohmann::json& list) { return list.get<std::vector<float>>(); }

float mapped(const NormRule& rule, Direction direction, double eps, float low, float high, float x) {
  return static_cast<float>(Normalizer(rule, direction, eps, {low}, {high}).map(x, 0));
}

}  // namespace

TEST_CASE("normalize and unnormalize equal the reference bit for bit in every kind") {
  int compared = 0;
  for (const auto& test : data_json("vectors.json")) {
    CAPTURE(test["kind"]);
    CAPTURE(test["inverse"]);
    const Direction direction = test["inverse"] ? Direction::unnormalize : Direction::normalize;
    std::vector<float> values = floats(test["x"]);
    const std::vector<float> low = floats(test["low"]), high = floats(test["high"]);
    const Normalizer normalizer(norm_rule(test["kind"].get<std::string>()), direction, test["eps"],
                                {low.begin(), low.end()}, {high.begin(), high.end()});
    for (std::size_t i = 0; i < values.size(); ++i) values[i] = static_cast<float>(normalizer.map(values[i], i));
    CHECK(values == floats(test["y"]));
    ++compared;
  }
  CHECK(compared == 18);
}

TEST_CASE("a zero standard deviation divides by eps, and gives back the mean") {
  CHECK(mapped(norm_rule("mean_std"), Direction::normalize, 1e-8, 2.0f, 0.0f, 2.5f) == 0.5f / 1e-8f);
  CHECK(mapped(norm_rule("mean_std"), Direction::normalize, 1e-8, 2.0f, 0.0f, 2.0f) == 0.0f);
  CHECK(mapped(norm_rule("mean_std"), Direction::unnormalize, 1e-8f, 2.0f, 0.0f, 123.0f) == 2.0f);
}

TEST_CASE("mean_std un-normalizes without eps") {
  CHECK(mapped(norm_rule("mean_std"), Direction::unnormalize, 0.5f, 1.0f, 2.0f, 3.0f) == 7.0f);
  CHECK(mapped(norm_rule("mean_std"), Direction::normalize, 0.5f, 1.0f, 2.0f, 3.5f) == 1.0f);
}

TEST_CASE("a range of zero is replaced by eps in both directions") {
  CHECK(mapped(norm_rule("min_max"), Direction::normalize, 0.5f, 3.0f, 3.0f, 3.0f) == -1.0f);
  CHECK(mapped(norm_rule("min_max"), Direction::unnormalize, 0.5f, 3.0f, 3.0f, 1.0f) == 3.5f);
  CHECK(mapped(norm_rule("quantiles"), Direction::unnormalize, 0.5f, 3.0f, 3.0f, 1.0f) == 3.5f);
}

TEST_CASE("kinds of openpi and of OpenVLA-OFT add eps in both directions") {
  CHECK(mapped(norm_rule("openpi_mean_std"), Direction::normalize, 0.5, 1.0f, 1.5f, 3.0f) == 1.0f);
  CHECK(mapped(norm_rule("openpi_mean_std"), Direction::unnormalize, 0.5, 1.0f, 1.5f, 3.0f) == 7.0f);
  CHECK(mapped(norm_rule("openpi_quantiles"), Direction::normalize, 0.5, 3.0f, 3.0f, 3.25f) == 0.0f);
  CHECK(mapped(norm_rule("openpi_quantiles"), Direction::unnormalize, 0.5, 3.0f, 3.0f, 0.0f) == 3.25f);
  CHECK(mapped(norm_rule("openvla_bounds"), Direction::normalize, 0.5, 3.0f, 3.0f, 3.25f) == 0.0f);
  CHECK(mapped(norm_rule("openvla_bounds"), Direction::unnormalize, 0.5, 3.0f, 3.0f, 0.0f) == 3.25f);
}

TEST_CASE("evo1's kinds add eps in both directions") {
  CHECK(mapped(norm_rule("evo1_mean_std"), Direction::normalize, 0.5, 1.0f, 1.5f, 3.0f) == 1.0f);
  CHECK(mapped(norm_rule("evo1_mean_std"), Direction::unnormalize, 0.5, 1.0f, 1.5f, 3.0f) == 7.0f);
  CHECK(mapped(norm_rule("evo1_min_max"), Direction::normalize, 0.5, 3.0f, 3.0f, 3.25f) == 0.0f);
  CHECK(mapped(norm_rule("evo1_quantiles"), Direction::unnormalize, 0.5, 3.0f, 3.0f, 0.0f) == 3.25f);
}

}  // namespace normalize_test
