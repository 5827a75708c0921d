// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Expected numbers: RotationTransform of Isaac-GR00T N1.5 with pytorch3d 0.7.6 and torch 2.13 in float32.
#include <cmath>

#include "processor/sample.h"

namespace rotation_test {

using namespace vla;
using namespace vla::test;
using Json = nlohmann::json;
using List = std::vector<Json>;

namespace {

// A sine of torch is off by a few units in the last place at most, and a turn multiplies some of them.
constexpr float kRounding = 5e-7f;

/// A gripper, a rotation, a rotation of three numbers, and what the ops make of them; an action of a number and a
/// rotation.
EditableBundle turning(const List& state_ops, const List& action_ops = {}, int n_rotation = 4) {
  EditableBundle bundle = sample();
  const auto n = static_cast<std::size_t>(n_rotation) + 4;
  bundle.set("observation.states", std::vector<std::string>{"state.grip", "state.hand", "state.base"});
  bundle.set("observation.state_dims", std::vector<std::int64_t>{1, n_rotation, 3});
  bundle.set("observation.state_names", std::vector<std::string>(n, "s"));
  bundle.set("observation.state_units", std::vector<std::string>(n, ""));
  bundle.set("action.names", std::vector<std::string>(4, "a"));
  bundle.set("action.units", std::vector<std::string>(4, ""));
  bundle.set("policy.d_state", std::int64_t{14});
  for (const char* name :
       {"stats.observation.state.mean", "stats.observation.state.std", "stats.action.mean", "stats.action.std"})
    bundle.erase(name);
  Json recipe = Json::parse(bundle.keys.string("processor.recipe").value());
  recipe["state"] = state_ops;
  recipe["state"].push_back({{"op", "pad"}, {"size", 14}});
  recipe["action"] = action_ops;
  bundle.set("processor.recipe", recipe.dump());
  return bundle;
}

Json turn(const std::string& from, int column, const char* normalize = "identity") {
  return {{"op", "rotation"}, {"from", from}, {"to", "rotation_6d"}, {"column", column}, {"normalize", normalize}};
}

Json turn_action(const std::string& to, int column = 1) {
  return {{"op", "rotation"}, {"from", "axis_angle"}, {"to", to}, {"column", column}};
}

Result<std::vector<float>> encoded(const EditableBundle& bundle, const std::vector<float>& hand,
                                   const std::vector<float>& base = {0, 0, 0}) {
  Observation observation;
  observation.states = {{"grip", {7}}, {"hand", hand}, {"base", base}};
  Inputs inputs;
  VLA_CHECK(make(bundle).encode_state(observation, inputs));
  CHECK(inputs.raw_state.size() == 4 + hand.size());
  return inputs.state;
}

void check_close(std::span<const float> found, const std::vector<float>& expected, float tolerance) {
  REQUIRE(found.size() == expected.size());
  for (std::size_t i = 0; i < found.size(); ++i) CHECK(std::abs(found[i] - expected[i]) <= tolerance);
}

std::string refused(const List& state_ops, const List& action_ops = {}) {
  return refusal(create(turning(state_ops, action_ops)), Code::bad_bundle);
}

}  // namespace

TEST_CASE("a quaternion of any length becomes two rows of its matrix, to the bit") {
  const auto state = encoded(turning({turn("quaternion", 1)}), {0.5f, -1.25f, 2.0f, 0.75f}, {3, 4, 5});
  CHECK(*state == std::vector<float>{7, -0.43137264f, -0.9019608f, 0.019607844f, -0.6666667f, 0.3333333f, 0.6666667f, 3,
                                     4, 5, 0, 0, 0, 0});
  const auto scaled = encoded(turning({turn("quaternion", 1, "groot_n1_5_min_max")}), {0.5f, -1.25f, 2.0f, 0.75f});
  check_close(std::span(*scaled).subspan(1, 6),
              {-0.43137264f, -0.9019608f, 0.019607902f, -0.6666667f, 0.33333325f, 0.66666675f}, 0);
}

TEST_CASE("three numbers of a rotation become two rows of its matrix") {
  const struct {
    std::string from;
    std::vector<float> given, expected;
  } cases[] = {
      {"axis_angle",
       {0.3f, -1.7f, 2.1f},
       {-0.88852215f, -0.44914317f, -0.09380326f, 0.18526745f, -0.16415727f, -0.96888f}},
      {"axis_angle", {3e-7f, -4e-7f, 1e-7f}, {1, -1.0000006e-07f, -3.9999998e-07f, 9.9999944e-08f, 1, -3.0000004e-07f}},
      {"euler_angles_rpy",
       {0.4f, -2.3f, 1.1f},
       {-0.3022202f, 0.59379005f, -0.74570525f, 0.68913597f, 0.67658854f, 0.2594601f}},
      {"euler_angles_ryp",
       {0.4f, -2.3f, 1.1f},
       {-0.3022202f, 0.74570525f, -0.59379005f, 0.03550455f, -0.6136808f, -0.78875554f}},
      {"euler_angles_pry",
       {0.4f, -2.3f, 1.1f},
       {0.15899077f, -0.9525767f, -0.2594601f, -0.59379005f, -0.3022202f, 0.74570525f}},
      {"euler_angles_pyr",
       {0.4f, -2.3f, 1.1f},
       {-0.6136808f, 0.65860045f, -0.4354782f, -0.74570525f, -0.3022202f, 0.59379005f}},
      {"euler_angles_yrp",
       {0.4f, -2.3f, 1.1f},
       {0.67658854f, 0.2594601f, 0.68913597f, -0.4354782f, -0.6136808f, 0.65860045f}},
      {"euler_angles_ypr",
       {0.4f, -2.3f, 1.1f},
       {-0.6136808f, -0.78875554f, 0.03550455f, -0.2594601f, 0.15899077f, -0.9525767f}},
  };
  for (const auto& one : cases) {
    CAPTURE(one.from);
    const auto state = encoded(turning({turn(one.from, 1)}, {}, 3), one.given);
    REQUIRE(state.ok());
    check_close(std::span(*state).subspan(1, 6), one.expected, one.given[0] < 1e-6f ? 1e-13f : kRounding);
  }
}

TEST_CASE("several rotations of a state keep their order, the last being turned first") {
  const List both = {turn("axis_angle", 5), turn("quaternion", 1)};
  const auto state = encoded(turning(both), {0.5f, -1.25f, 2.0f, 0.75f}, {0.3f, -1.7f, 2.1f});
  check_close(*state,
              {7, -0.43137264f, -0.9019608f, 0.019607844f, -0.6666667f, 0.3333333f, 0.6666667f, -0.88852215f,
               -0.44914317f, -0.09380326f, 0.18526745f, -0.16415727f, -0.96888f, 0},
              kRounding);
  CHECK(contains(refused({both[1], both[0]}),
                 "processor.recipe.state[1].column: expected a feature in front of column 1, found 5"));
  CHECK(contains(refused({{{"op", "sin_cos"}, {"columns", {0}}}, both[1]}), "a feature in front of column 0, found 1"));
}

TEST_CASE("an axis times an angle becomes Euler angles") {
  const struct {
    std::string to;
    std::vector<float> expected;
  } cases[] = {
      {"euler_angles_rpy", {0.8904814f, 0.22333227f, 1.2980365f}},
      {"euler_angles_ryp", {1.5601778f, 1.220043f, 0.70047027f}},
      {"euler_angles_pry", {0.3464944f, 0.86034626f, 1.5652019f}},
      {"euler_angles_pyr", {-1.2169222f, 0.7104366f, 1.5659834f}},
      {"euler_angles_yrp", {1.5669113f, 0.35073292f, -0.85901916f}},
      {"euler_angles_ypr", {1.187868f, -0.7910681f, 0.51057947f}},
  };
  for (const auto& one : cases) {
    CAPTURE(one.to);
    const Processor processor = make(turning({turn("quaternion", 1)}, {turn_action(one.to)}));
    const auto row = processor.decode(std::vector<float>{5, 0.9f, -0.4f, 1.3f}, 1, 4, std::vector<float>(8));
    REQUIRE(row.ok());
    CHECK(row->front() == 5);
    check_close(std::span(*row).subspan(1), one.expected, 2 * kRounding);
  }
}

TEST_CASE("numbers that are no rotation are refused by the feature's name") {
  const auto bundle = turning({turn("quaternion", 1)});
  for (const std::vector<float>& none : {std::vector<float>{0, 0, 0, 0}, {1e-30f, 0, 0, 0}}) {
    const auto state = encoded(bundle, none);
    CHECK(contains(refusal(state, Code::bad_observation), "state.hand: expected a rotation, found numbers of none"));
  }
  CHECK(encoded(bundle, {0, 0, 0, 1e-6f}).ok());
}

TEST_CASE("a rotation stands for a whole feature, and behind what normalizes") {
  for (const int column : {0, 2, 5, 8, 99})
    CHECK(contains(refused({turn("quaternion", column)}),
                   "processor.recipe.state[0].column: expected the first column of a feature of 4 numbers"));
  CHECK(contains(refused({turn("quaternion", 1), {{"op", "sin_cos"}, {"columns", {0}}}}), "one sin_cos, before pad"));
  CHECK(contains(refused({{{"op", "pad"}, {"size", 14}}, turn("quaternion", 1)}), "expected rotation before pad"));
  CHECK(contains(refused({turn("matrix", 1)}), "processor.recipe.state[0].from"));
  CHECK(contains(refused({turn("quaternion", 1, "mean_std")}), "processor.recipe.state[0].normalize"));
  CHECK(contains(refused({turn("quaternion", 1)}, {turn_action("quaternion")}), "processor.recipe.action[0].to"));
  CHECK(contains(refused({turn("quaternion", 1)}, {turn_action("euler_angles_rpy", 2)}),
                 "processor.recipe.action[0].column: expected 3 columns of 4 from here on, found 2"));
}

}  // namespace rotation_test
