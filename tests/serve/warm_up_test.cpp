// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/warm_up.h"

#include <cstring>
#include <limits>

#include "serve/support.h"
#include "support/joint_bundle.h"

namespace warm_up_test {

using namespace vla;
using namespace vla::test;

namespace {

/// A bundle one number of which is not one.
std::string broken(EditableBundle bundle, const std::string& tensor, float value) {
  std::memcpy(bundle.tensor(tensor).data.data(), &value, sizeof(value));
  return bundle.write("broken.gguf");
}

EditableBundle sound_bundle() { return EditableBundle::read(kGolden + "/bundle.gguf"); }

Error refusal(const std::string& bundle) {
  const auto warm = serve::warm_up(*load_engine(bundle));
  REQUIRE_FALSE(warm.ok());
  return warm.error();
}

bool contains(const std::string& text, const std::string& part) { return text.find(part) != std::string::npos; }

constexpr float kNan = std::numeric_limits<float>::quiet_NaN();

}  // namespace

TEST_CASE("a sound policy of every architecture is warm after an act, and no value of its network is not finite") {
  for (const std::string& path : golden_paths()) {
    CAPTURE(path);
    const auto engine = load_engine(path + "/bundle.gguf");
    const auto warm = serve::warm_up(*engine);
    CHECK_MESSAGE(warm.ok(), (warm ? "" : warm.error().message()));
    const GoldenCase read = GoldenCase::read(path);
    const auto found = engine->find_not_finite(read.observation, Noise(std::uint64_t{1}));
    REQUIRE_MESSAGE(found.ok(), (found ? "" : found.error().message()));
    CHECK(*found == "");
    CHECK(engine->act(read.observation, Noise(std::uint64_t{1})).ok());
  }
}

TEST_CASE("a policy whose actions are not finite is refused by the first tap that is not") {
  for (const auto& [tensor, tap] : {std::pair{"vision.blk.0.attn_norm.weight", "vision.blk.0"},
                                    {"lm.blk.1.attn_norm.weight", "lm.blk.1"},
                                    {"action_out.bias", "step.0"}}) {
    CAPTURE(tensor);
    for (const float value : {kNan, std::numeric_limits<float>::infinity()}) {
      const Error error = refusal(broken(sound_bundle(), tensor, value));
      CAPTURE(error.message());
      CHECK(error.code == Code::bad_action);
      CHECK(contains(error.message(), "broken.gguf: warm-up: expected finite actions"));
      CHECK(contains(error.found, "first at the tap " + std::string(tap)));
    }
  }
}

TEST_CASE("one robot of several that is not finite is refused by its tag") {
  const auto is_robots_own = [](const std::string& name) { return name.starts_with("action_out"); };
  const EditableBundle sound = sound_bundle();
  EditableBundle other = sound;
  std::memcpy(other.tensor("action_out.bias").data.data(), &kNan, sizeof(kNan));
  const std::string joint = joint_bundle({{"arm", sound}, {"dog", other}}, is_robots_own).write("joint.gguf");
  auto engine = Engine::load(joint, {.n_thread = 1, .all_robots = true});
  REQUIRE_MESSAGE(engine.ok(), (engine ? "" : engine.error().message()));
  const auto warm = serve::warm_up(**engine);
  REQUIRE_FALSE(warm.ok());
  CHECK(contains(warm.error().where, "joint.gguf of dog: warm-up"));
}

}  // namespace warm_up_test
