// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// One engine for several robots.
#include <doctest/doctest.h>

#include <algorithm>

#include "support/editable_bundle.h"
#include "support/golden_case.h"
#include "support/joint_bundle.h"

namespace embodiments_test {

using namespace vla;
using namespace vla::test;

namespace {

const std::string kCase = "gr00t_n1_7/libero";

/// The golden bundle, and one whose robot has other weights and a state of another name.
EditableBundle arm() { return EditableBundle::read(golden_path(kCase) + "/bundle.gguf"); }
EditableBundle dog() {
  EditableBundle bundle = arm();
  std::string& weights = bundle.tensor("decode_out.weight").data;
  for (std::size_t i = 1; i < weights.size(); i += 4) weights[i] = static_cast<char>(weights[i] ^ 1);
  std::vector<std::string> states = *bundle.keys.strings("observation.states");
  states.front() = "state.paw";
  bundle.set("observation.states", Value(states));
  return bundle;
}

EditableBundle both() { return joint_bundle({{"arm", arm()}, {"dog", dog()}}, is_robots_own); }

std::unique_ptr<Engine> load(const EditableBundle& bundle, const std::string& file, EngineOptions options) {
  options.n_thread = 1;
  auto engine = Engine::load(bundle.write(file), options);
  REQUIRE_MESSAGE(engine.ok(), (engine ? "" : engine.error().message()));
  return std::move(*engine);
}

/// The observation with the first state of the bundle under another name.
Observation with_paw(Observation observation) {
  const std::string first = arm().keys.strings("observation.states")->front();
  const auto place = std::find_if(observation.states.begin(), observation.states.end(), [&](const auto& state) {
    return first == state.first || first.ends_with("." + state.first);
  });
  REQUIRE(place != observation.states.end());
  auto node = observation.states.extract(place);
  node.key() = "state.paw";
  observation.states.insert(std::move(node));
  return observation;
}

}  // namespace

TEST_CASE("every robot of an engine answers the bits of its bundle alone, in any order") {
  const GoldenCase golden = GoldenCase::read(golden_path(kCase));
  const auto engine = load(both(), "both.gguf", {.all_robots = true});
  const auto alone_arm = load(arm(), "arm.gguf", {}), alone_dog = load(dog(), "dog.gguf", {});
  Observation of_arm = golden.observation, of_dog = with_paw(golden.observation);
  const auto expected_arm = alone_arm->act(of_arm, golden.noise), expected_dog = alone_dog->act(of_dog, golden.noise);
  REQUIRE(expected_arm.ok());
  REQUIRE(expected_dog.ok());
  CHECK(expected_arm->actions != expected_dog->actions);
  of_arm.embodiment = "arm", of_dog.embodiment = "dog";
  for (int i = 0; i < 2; ++i) {
    CHECK(engine->act(of_arm, golden.noise)->actions == expected_arm->actions);
    CHECK(engine->act(of_dog, golden.noise)->actions == expected_dog->actions);
  }
}

TEST_CASE("what robots share is in memory once") {
  const auto engine = load(both(), "both.gguf", {.dry = true, .all_robots = true});
  const auto alone = load(arm(), "arm.gguf", {.dry = true});
  CHECK(engine->robots().size() == 2);
  CHECK(engine->memory().weights > alone->memory().weights);
  CHECK(engine->memory().weights < alone->memory().weights * 3 / 2);
  CHECK(engine->memory().working < alone->memory().working * 3 / 2);
  CHECK(engine->memory().plan == 2 * alone->memory().plan);
}

TEST_CASE("robots whose tokenizers are described alike have one, and its description is not kept") {
  EditableBundle bundle = both();
  const std::string added = *bundle.keys.string("tokenizer.added");
  bundle.remove_key("tokenizer.added");
  for (const bool alike : {true, false}) {
    bundle.set("embodiment.arm.tokenizer.added", Value(added));
    bundle.set("embodiment.dog.tokenizer.added", Value(added + (alike ? "" : " ")));
    const auto engine = load(bundle, "both.gguf", {.dry = true, .all_robots = true});
    const std::vector<const Robot*> robots = engine->robots();
    CHECK((robots[0]->processor().tokenizer() == robots[1]->processor().tokenizer()) == alike);
    for (const Robot* robot : robots) CHECK_FALSE(robot->bundle().keys().has("tokenizer.tokens"));
  }
}

TEST_CASE("an observation of no robot, or of one that is not there, is refused with the list") {
  const GoldenCase golden = GoldenCase::read(golden_path(kCase));
  const auto engine = load(both(), "both.gguf", {.all_robots = true});
  for (const std::string tag : {"", "cat"}) {
    Observation observation = golden.observation;
    observation.embodiment = tag;
    const auto chunk = engine->act(observation, golden.noise);
    REQUIRE_FALSE(chunk.ok());
    CHECK(chunk.error().code == Code::bad_observation);
    CHECK(chunk.error().where == "embodiment");
    CHECK(chunk.error().expected == "one of arm, dog");
    CHECK(chunk.error().found == (tag.empty() ? "none" : tag));
  }
}

TEST_CASE("an engine of one robot needs no tag, and takes no other than its own") {
  const GoldenCase golden = GoldenCase::read(golden_path(kCase));
  const auto chosen = load(both(), "both.gguf", {.embodiment = "arm", .all_robots = true});
  const auto nameless = load(arm(), "arm.gguf", {.all_robots = true});
  Observation observation = golden.observation;
  const auto expected = nameless->act(observation, golden.noise);
  REQUIRE(expected.ok());
  CHECK(chosen->act(observation, golden.noise)->actions == expected->actions);
  observation.embodiment = "arm";
  CHECK(chosen->act(observation, golden.noise)->actions == expected->actions);
  CHECK(nameless->act(observation, golden.noise).error().where == "embodiment");
  observation.embodiment = "dog";
  CHECK(chosen->act(observation, golden.noise).error().expected == "one of arm");
}

TEST_CASE("a bundle of several robots is not loaded as one of them unless it is said which") {
  const auto engine = Engine::load(both().write("both.gguf"), {.n_thread = 1, .dry = true});
  REQUIRE_FALSE(engine.ok());
  CHECK(engine.error().code == Code::usage);
  CHECK(engine.error().expected == "one of arm, dog");
}

}  // namespace embodiments_test
