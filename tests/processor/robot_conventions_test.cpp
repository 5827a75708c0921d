// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// A state in the prompt, relative actions, and numbers that are flipped or stretched between robot and network.
#include "processor/sample.h"

namespace robot_conventions_test {

using namespace vla;
using namespace vla::test;
using Json = nlohmann::json;

namespace {

/// The sample with the state in the prompt, relative actions, and a flipped and stretched second number.
EditableBundle robot() {
  EditableBundle bundle = sample();
  Json recipe = Json::parse(*bundle.keys.string("processor.recipe"));
  recipe["text"] = Json::parse(R"([{"op": "strip"}, {"op": "template", "text": "{instruction} {state}"},
                                   {"op": "tokenize", "max_tokens": 32, "truncate": "right"}])");
  bundle.set("observation.max_text_tokens", std::int64_t{32});
  recipe["state"] = Json::parse(R"([{"op": "affine", "columns": [1], "scale": -2.0, "shift": 1.0},
    {"op": "normalize", "kind": "mean_std", "stats": "stats.observation.state", "eps": 0.5},
    {"op": "bins", "low": -1.0, "high": 1.0, "count": 256}])");
  recipe["action"].push_back(Json::parse(R"({"op": "add_state", "columns": [1]})"));
  recipe["action"].push_back(Json::parse(R"({"op": "affine", "columns": [0, 1], "scale": 2.0, "shift": 0.0})"));
  bundle.set("processor.recipe", recipe.dump());
  bundle.set("policy.d_state", std::int64_t{0});
  return bundle;
}

std::string refused_robot(const char* pointer, const Json& value) {
  EditableBundle bundle = robot();
  Json recipe = Json::parse(*bundle.keys.string("processor.recipe"));
  recipe[Json::json_pointer(pointer)] = value;
  bundle.set("processor.recipe", recipe.dump());
  return refusal(create(bundle), Code::bad_bundle);
}

}  // namespace

TEST_CASE("a state in words goes into the prompt and the network sees no other") {
  Observation seen = observation();
  seen.text = " go ";
  seen.states["state"] = {1.0f, 0.0f};  // normalized: 0 and (1 - 2) / 2
  const auto inputs = make(robot()).encode(seen);
  REQUIRE_MESSAGE(inputs.ok(), inputs.error().message());
  CHECK(inputs->state.empty());
  CHECK(inputs->discretized_state == std::vector<int>{128, 64});
  CHECK(inputs->raw_state == std::vector<float>{1.0f, 1.0f});
  CHECK(inputs->tokens == *Tokenizer::create(tokenizer_keys("smol"), 4096)->encode("go 128 64"));
  Inputs empty;
  refusal(make(robot()).encode_text(seen, empty), Code::internal);
}

TEST_CASE("relative actions are added to the state of their observation, in the robot's conventions") {
  const std::vector<float> chunk = {1.0f, 5.0f, 0.0f, 0.0f};
  const auto actions = make(robot()).decode(chunk, 1, 4, std::vector<float>{3.0f, 4.0f});
  REQUIRE(actions.ok());
  CHECK(*actions == std::vector<float>{2 * 12.0f, 2 * (20.0f + 4.0f)});
  refusal(make(robot()).decode(chunk, 1, 4, std::vector<float>{3.0f}), Code::internal);
}

TEST_CASE("columns beyond the state or the action are refused") {
  CHECK(contains(refused_robot("/state/0/columns", Json{2}), "processor.recipe.state[0].columns"));
  CHECK(contains(refused_robot("/action/2/columns", Json{2}), "processor.recipe.action[2].columns"));
  CHECK(contains(refused_robot("/action/3/columns", Json{2}), "processor.recipe.action[3].columns"));
}

TEST_CASE("a state that the network does not see leaves nothing for policy.d_state") {
  EditableBundle bundle = robot();
  bundle.set("policy.d_state", std::int64_t{2});
  CHECK(contains(refusal(create(bundle), Code::bad_bundle), "policy.d_state"));
}

}  // namespace robot_conventions_test
