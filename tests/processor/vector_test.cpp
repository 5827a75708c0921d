// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/vector.h"

#include "processor/support.h"

using namespace vla;
using namespace vla::test;
using Direction = Normalizer::Direction;

namespace {

NormKind kind_of(const std::string& name) {
  const std::map<std::string, NormKind> kinds = {{"mean_std", NormKind::mean_std},
                                                 {"min_max", NormKind::min_max},
                                                 {"quantiles", NormKind::quantiles},
                                                 {"quantile10", NormKind::quantile10},
                                                 {"openpi_mean_std", NormKind::openpi_mean_std},
                                                 {"openpi_quantiles", NormKind::openpi_quantiles},
                                                 {"evo1_mean_std", NormKind::evo1_mean_std},
                                                 {"evo1_min_max", NormKind::evo1_min_max},
                                                 {"evo1_quantiles", NormKind::evo1_quantiles}};
  return kinds.at(name);
}

std::vector<float> floats(const nlohmann::json& list) { return list.get<std::vector<float>>(); }

float mapped(NormKind kind, Direction direction, double eps, float low, float high, float x) {
  std::vector<float> values = {x};
  Normalizer(kind, direction, eps, {low}, {high}).apply(values);
  return values[0];
}

}  // namespace

TEST_CASE("normalize and unnormalize equal the reference bit for bit in every kind") {
  int compared = 0;
  for (const auto& test : data_json("vectors.json")) {
    CAPTURE(test["kind"]);
    CAPTURE(test["inverse"]);
    const Direction direction = test["inverse"] ? Direction::unnormalize : Direction::normalize;
    std::vector<float> values = floats(test["x"]);
    Normalizer(kind_of(test["kind"]), direction, test["eps"], floats(test["low"]), floats(test["high"])).apply(values);
    CHECK(values == floats(test["y"]));
    ++compared;
  }
  CHECK(compared == 18);
}

TEST_CASE("a zero standard deviation divides by eps, and gives back the mean") {
  CHECK(mapped(NormKind::mean_std, Direction::normalize, 1e-8, 2.0f, 0.0f, 2.5f) == 0.5f / 1e-8f);
  CHECK(mapped(NormKind::mean_std, Direction::normalize, 1e-8, 2.0f, 0.0f, 2.0f) == 0.0f);
  CHECK(mapped(NormKind::mean_std, Direction::unnormalize, 1e-8f, 2.0f, 0.0f, 123.0f) == 2.0f);
}

TEST_CASE("mean_std un-normalizes without eps") {
  CHECK(mapped(NormKind::mean_std, Direction::unnormalize, 0.5f, 1.0f, 2.0f, 3.0f) == 7.0f);
  CHECK(mapped(NormKind::mean_std, Direction::normalize, 0.5f, 1.0f, 2.0f, 3.5f) == 1.0f);
}

TEST_CASE("a range of zero is replaced by eps in both directions") {
  CHECK(mapped(NormKind::min_max, Direction::normalize, 0.5f, 3.0f, 3.0f, 3.0f) == -1.0f);
  CHECK(mapped(NormKind::min_max, Direction::unnormalize, 0.5f, 3.0f, 3.0f, 1.0f) == 3.5f);
  CHECK(mapped(NormKind::quantiles, Direction::unnormalize, 0.5f, 3.0f, 3.0f, 1.0f) == 3.5f);
}

TEST_CASE("identity changes nothing") {
  std::vector<float> values = {1.0f, -2.0f};
  Normalizer(NormKind::identity, Direction::normalize, 0.0f, {}, {}).apply(values);
  CHECK(values == std::vector<float>{1.0f, -2.0f});
}

TEST_CASE("openpi's kinds add eps in both directions") {
  CHECK(mapped(NormKind::openpi_mean_std, Direction::normalize, 0.5, 1.0f, 1.5f, 3.0f) == 1.0f);
  CHECK(mapped(NormKind::openpi_mean_std, Direction::unnormalize, 0.5, 1.0f, 1.5f, 3.0f) == 7.0f);
  CHECK(mapped(NormKind::openpi_quantiles, Direction::normalize, 0.5, 3.0f, 3.0f, 3.25f) == 0.0f);
  CHECK(mapped(NormKind::openpi_quantiles, Direction::unnormalize, 0.5, 3.0f, 3.0f, 0.0f) == 3.25f);
}

TEST_CASE("evo1's kinds add eps in both directions") {
  CHECK(mapped(NormKind::evo1_mean_std, Direction::normalize, 0.5, 1.0f, 1.5f, 3.0f) == 1.0f);
  CHECK(mapped(NormKind::evo1_mean_std, Direction::unnormalize, 0.5, 1.0f, 1.5f, 3.0f) == 7.0f);
  CHECK(mapped(NormKind::evo1_min_max, Direction::normalize, 0.5, 3.0f, 3.0f, 3.25f) == 0.0f);
  CHECK(mapped(NormKind::evo1_quantiles, Direction::unnormalize, 0.5, 3.0f, 3.0f, 0.0f) == 3.25f);
}
