// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Expected numbers: scipy.spatial.transform.Rotation 1.17, with rows made orthogonal as the authors' EndEffectorPose
// does.
#include "processor/ops/pose.h"

#include <cmath>

#include "processor/sample.h"

namespace pose_test {

using namespace vla;
using namespace vla::test;
using Json = nlohmann::json;

namespace {

void check_close(std::span<const double> found, const std::vector<double>& expected, double tolerance) {
  REQUIRE(found.size() == expected.size());
  for (std::size_t i = 0; i < found.size(); ++i) CHECK(std::abs(found[i] - expected[i]) < tolerance);
}

std::vector<double> composed(PoseFormat format, const std::vector<float>& reference,
                             const std::vector<double>& action) {
  std::vector<double> out(pose_size(format));
  write_pose(format, compose(read_pose(format, std::span(reference)), read_pose(format, std::span(action))), out);
  return out;
}

const std::vector<float> kReference = {-0.8f, -1.32f, -0.25f, 0.42f, 1.14f, 0.11f, -0.55f, -0.78f, 0.75f};
const std::vector<float> kAction = {1.63f, 0.27f, -1.23f, -0.96f, 1.6f, 0.2f, -1.73f, -0.08f, -1.16f};
const std::vector<double> kComposed = {-0.097388345744247484, -2.973679294970645,    0.75716523441572203,
                                       -0.87495230249758837,  -0.061113538129846323, -0.4803369690242682,
                                       -0.33638366721214208,  -0.63682350117144482,  0.69375922104765853};

EditableBundle posed() {
  EditableBundle bundle = sample();
  bundle.set("observation.state_dims", std::vector<std::int64_t>{10});
  bundle.set("observation.state_names", std::vector<std::string>(10, "s"));
  bundle.set("observation.state_units", std::vector<std::string>(10, ""));
  bundle.set("action.names", std::vector<std::string>(9, "a"));
  bundle.set("action.units", std::vector<std::string>(9, ""));
  bundle.set("policy.d_state", std::int64_t{10});
  bundle.set("policy.d_action", std::int64_t{9});
  Json recipe = Json::parse(bundle.keys.string("processor.recipe").value());
  recipe["state"] = Json::array();
  recipe["action"] = {{{"op", "compose_pose"}, {"format", "xyz_rot6d"}, {"column", 0}, {"state_column", 1}}};
  bundle.set("processor.recipe", recipe.dump());
  return bundle;
}

std::string refused(const char* pointer, const Json& value) {
  EditableBundle bundle = posed();
  Json recipe = Json::parse(bundle.keys.string("processor.recipe").value());
  recipe[Json::json_pointer(pointer)] = value;
  bundle.set("processor.recipe", recipe.dump());
  return refusal(create(bundle), Code::bad_bundle);
}

}  // namespace

TEST_CASE("a pose by two rows is composed with the observed one") {
  // Rows of the state are made orthogonal in float32, and the numbers above are rounded to it: hence the tolerance.
  check_close(composed(PoseFormat::rotation_6d, kReference, {kAction.begin(), kAction.end()}), kComposed, 3e-7);
}

TEST_CASE("a pose by a rotation vector is composed, near none and near half a turn too") {
  const std::vector<double> action = {-0.25, 0.5, 1, 0.3, -0.2, 0.1};
  const auto check = [&](const std::vector<float>& reference, const std::vector<double>& expected) {
    check_close(composed(PoseFormat::rotation_vector, reference, action), expected, 1e-12);
  };
  check({0.5f, -1, 2, 2, -1.5f, 0.75f}, {0.078083915151259342, -1.6508069037928719, 1.1568290853442313,
                                         2.2915031869973386, -1.6951085974938553, 0.88192937453330544});
  check({0.5f, -1, 2, 1e-4f, 0, 2e-4f}, {0.24990001500335868, -0.50015001249496005, 3.0000499924983206,
                                         0.30012008277209601, -0.19997583434742497, 0.10018807920862412});
  check({0.5f, -1, 2, 3.1f, 0.1f, 0.2f}, {0.41299764042107767, -1.5445702816706279, 0.99582182967917787,
                                          -2.8738512002529033, 0.029124787187954207, 0.11576133096992865});
}

TEST_CASE("the recipe composes the pose that the state holds, and names what is no direction") {
  const Processor processor = make(posed());
  CHECK(processor.relative_actions());
  std::vector<float> state = {9};
  state.insert(state.end(), kReference.begin(), kReference.end());
  const auto actions = processor.decode(kAction, 1, 9, state);
  REQUIRE(actions.ok());
  check_close(std::vector<double>(actions->begin(), actions->end()), kComposed, 3e-7);
  std::fill(state.begin() + 4, state.begin() + 7, 0.0f);
  CHECK(contains(refusal(processor.decode(kAction, 1, 9, state), Code::bad_action), "a finite number"));
}

TEST_CASE("a pose must lie within the action and within the state") {
  CHECK(contains(refused("/action/0/column", 1), "processor.recipe.action[0].column: expected 9 columns of 9"));
  CHECK(contains(refused("/action/0/state_column", 2),
                 "processor.recipe.action[0].state_column: expected 9 columns of 10"));
  CHECK(contains(refused("/action/0/format", "quaternion"), "processor.recipe.action[0].format"));
}

}  // namespace pose_test
