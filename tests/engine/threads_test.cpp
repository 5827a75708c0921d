// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Also built with the thread sanitizer (`make tsan`).
#include <doctest/doctest.h>

#include <array>
#include <thread>

#include "support/editable_bundle.h"
#include "support/golden_case.h"
#include "support/joint_bundle.h"

namespace threads_test {

using namespace vla;
using namespace vla::test;

TEST_CASE("while one thread acts two others prepare for either robot, and no answer changes") {
  constexpr int kRounds = 6;
  const GoldenCase golden = GoldenCase::read(golden_path("gr00t_n1_7/libero"));
  const EditableBundle one = EditableBundle::read(golden.bundle());
  const std::string file = joint_bundle({{"arm", one}, {"dog", one}}, is_robots_own).write("both.gguf");
  auto loaded = Engine::load(file, {.n_thread = 1, .all_robots = true});
  REQUIRE_MESSAGE(loaded.ok(), (loaded ? "" : loaded.error().message()));
  Engine& engine = **loaded;
  // Of every round another length of the text, so that acts build plans.
  const auto observation = [&](int round, const char* robot) {
    Observation of_robot = golden.observation;
    of_robot.embodiment = robot;
    for (int i = 0; i < round % 3; ++i) *of_robot.text += " please";
    return of_robot;
  };
  std::vector<std::vector<float>> expected;
  for (int round = 0; round < 3; ++round)
    expected.push_back(engine.act(observation(round, "arm"), golden.noise)->actions);

  std::array<std::array<EncodedObservation, 2>, 2> turns;  // of one round, and of the next
  const auto prepare = [&](int round, std::size_t robot) {
    return engine.encode(observation(round, robot == 0 ? "arm" : "dog"), golden.noise, {},
                         turns[static_cast<std::size_t>(round) % 2][robot]);
  };
  REQUIRE(prepare(0, 0).ok());
  REQUIRE(prepare(0, 1).ok());
  for (int round = 0; round < kRounds; ++round) {
    CAPTURE(round);
    Status arm, dog;
    std::thread of_arm([&] { arm = prepare(round + 1, 0); }), of_dog([&] { dog = prepare(round + 1, 1); });
    for (EncodedObservation& encoded : turns[static_cast<std::size_t>(round) % 2]) {
      const auto chunk = engine.compute(encoded);
      CHECK(chunk.ok());
      if (chunk) CHECK(chunk->actions == expected[static_cast<std::size_t>(round % 3)]);
    }
    of_arm.join(), of_dog.join();
    REQUIRE(arm.ok());
    REQUIRE(dog.ok());
  }
}

}  // namespace threads_test
