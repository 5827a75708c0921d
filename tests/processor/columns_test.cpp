// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/ops/columns.h"

#include <cmath>

#include "processor/support.h"

namespace columns_test {

using namespace vla;
using namespace vla::test;

namespace {

const std::vector<int> kFlipped = {1, 2, 8, 9};
const std::vector<int> kGrippers = {6, 13};

/// Both are float32 results of a few operations whose reference runs in double throughout.
void check_close(const std::vector<float>& found, const nlohmann::json& expected) {
  REQUIRE(found.size() == expected.size());
  for (std::size_t i = 0; i < found.size(); ++i)
    CHECK(found[i] == doctest::Approx(expected[i].get<double>()).epsilon(1e-6));
}

}  // namespace

TEST_CASE("an ALOHA state turns into joint angles and servo angles as the reference has them") {
  for (const auto& test : data_json("aloha.json")) {
    std::vector<float> state = test["x"].get<std::vector<float>>();
    map_columns(ColumnAffine{kFlipped, -1.0, 0.0}, state);
    map_columns(HornAngle{kGrippers, 0.058 - 0.01844, 0.01844, 0.036, 0.022}, state);
    map_columns(ColumnAffine{kGrippers, 1 / (1.6296 - 0.5476), -0.5476 / (1.6296 - 0.5476)}, state);
    check_close(state, test["state"]);
  }
}

TEST_CASE("ALOHA actions come back to the robot's conventions as the reference has them") {
  for (const auto& test : data_json("aloha.json")) {
    std::vector<float> action = test["x"].get<std::vector<float>>();
    map_columns(ColumnAffine{kFlipped, -1.0, 0.0}, action);
    map_columns(ColumnAffine{kGrippers, 1 / (1.491 + 0.6213), (0.5476 + 0.6213) / (1.491 + 0.6213)}, action);
    check_close(action, test["action"]);
  }
}

TEST_CASE("a horn that cannot reach the opening stays at its end") {
  std::vector<float> values = {1.0f, 0.0f, -1.0f};
  map_columns(HornAngle{{0, 1, 2}, 1.0, 0.0, 0.036, 0.022}, values);
  CHECK(values[0] == static_cast<float>(std::asin(1.0)));
  CHECK(values[1] == static_cast<float>(std::asin(-1.0)));
  CHECK(values[2] == static_cast<float>(std::asin(-1.0)));
}

TEST_CASE("a threshold gives one of two values, and leaves what is no number to be found") {
  std::vector<float> values = {0.5f, std::nextafter(0.5f, 1.0f), -3.0f, NAN, INFINITY, 9.0f};
  map_columns(Threshold{{0, 1, 2, 3, 4}, 0.5f, -1.0f, 1.0f}, values);
  CHECK(values[0] == 1.0f);
  CHECK(values[1] == -1.0f);
  CHECK(values[2] == 1.0f);
  CHECK(std::isnan(values[3]));
  CHECK(std::isinf(values[4]));
  CHECK(values[5] == 9.0f);
}

TEST_CASE("the sigmoid of a column's numbers is from 0 to 1, and what is no number stays to be found") {
  std::vector<float> x = {0, -200, 200, 1.5f, NAN};
  map_columns(Sigmoid{{0, 1, 2, 4}}, x);
  CHECK(x[0] == 0.5f);
  CHECK(x[1] < 1e-30f);
  CHECK(x[2] == 1.0f);
  CHECK(x[3] == 1.5f);
  CHECK(std::isnan(x[4]));
  map_columns(Sigmoid{{3}}, x);
  CHECK(x[3] == static_cast<float>(0.81757447619364));  // torch rounds it to the number below
}

}  // namespace columns_test
