// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Bad bundles and bad observations end to end: each is one typed error that names its place, and the engine goes on.
#include <doctest/doctest.h>

#include <cmath>
#include <cstring>
#include <limits>

#include "bundle/run_keys.h"
#include "support/editable_bundle.h"
#include "support/golden_case.h"

namespace refusal_test {

using namespace vla;
using namespace vla::test;

namespace {

const std::string kCase = golden_path("smolvla/two_views");

EditableBundle sound_bundle() { return EditableBundle::read(kCase + "/bundle.gguf"); }

/// The error with which a changed bundle is refused.
Error refusal(const EditableBundle& bundle) {
  const auto engine = Engine::load(bundle.write("changed.gguf"), {.n_thread = 1});
  REQUIRE_FALSE(engine.ok());
  return engine.error();
}

void check_refused(const EditableBundle& bundle, Code code, const std::string& part) {
  const Error error = refusal(bundle);
  CAPTURE(error.message());
  CHECK(error.code == code);
  CHECK(error.message().find(part) != std::string::npos);
}

/// The error with which an observation is refused; afterwards the engine must still answer the sound one.
void check_observation_refused(const Observation& bad, const Noise& noise, Code code, const std::string& part) {
  const GoldenCase golden = GoldenCase::read(kCase);
  const auto engine = load_engine(golden.bundle());
  const auto chunk = engine->act(bad, noise);
  REQUIRE_FALSE(chunk.ok());
  CAPTURE(chunk.error().message());
  CHECK(chunk.error().code == code);
  CHECK(chunk.error().message().find(part) != std::string::npos);
  CHECK(engine->act(golden.observation, golden.noise).ok());
}

/// Values that no key of this type may have.
std::vector<Value> absurd(const Value& value) {
  constexpr std::int64_t kLargest = std::numeric_limits<std::int64_t>::max();
  if (std::holds_alternative<std::int64_t>(value)) return {std::int64_t{-1}, std::int64_t{INT32_MAX}, kLargest};
  if (std::holds_alternative<std::vector<std::int64_t>>(value))
    return {std::vector<std::int64_t>{-1}, std::vector<std::int64_t>{INT32_MAX}};
  if (std::holds_alternative<double>(value)) return {-1e30, -1000.0, 1e30, std::nan("")};
  return {};
}

}  // namespace

TEST_CASE("a ternary code that stands for no number and a factor that is missing are refused by their tensors") {
  EditableBundle bundle = EditableBundle::read(golden_path("bitvla/micro") + "/bundle.gguf");
  bundle.tensor("lm.blk.0.attn_q.weight").data[5] = '\xFF';
  bundle.erase("vision.blk.0.ffn_up.scale");
  check_refused(bundle, Code::bad_bundle, "lm.blk.0.attn_q.weight");
  check_refused(bundle, Code::bad_bundle, "vision.blk.0.ffn_up.scale");
}

TEST_CASE("a bundle of an architecture that this build does not know is unsupported") {
  EditableBundle bundle = sound_bundle();
  bundle.set("vla.arch", Value(std::string("octo")));
  check_refused(bundle, Code::unsupported, "xvla, found octo");
}

TEST_CASE("missing, extra and misshapen tensors are named in one error") {
  EditableBundle bundle = sound_bundle();
  bundle.erase("expert.norm.weight");
  bundle.erase("vision.blk.0.attn_q.bias");
  bundle.tensors.push_back({"lm.blk.99.attn_q.weight", DType::f32, {1}, std::string(4, '\0')});
  bundle.tensor("state_in.weight").shape = {
      4, bundle.tensor("state_in.weight").shape[0] * bundle.tensor("state_in.weight").shape[1] / 4};
  const std::string message = refusal(bundle).message();
  CAPTURE(message);
  for (const char* part :
       {"4 problems", "missing tensor  expert.norm.weight", "missing tensor  vision.blk.0.attn_q.bias",
        "unused tensor   lm.blk.99.attn_q.weight", "wrong shape     state_in.weight"})
    CHECK(message.find(part) != std::string::npos);
}

TEST_CASE("every required key is missed when it is gone") {
  // Of the tokenizer, the processor and the network alike; a key that nobody misses would be a default in hiding.
  const EditableBundle sound = sound_bundle();
  int n_checked = 0;
  for (const auto& [key, value] : sound.keys.all()) {
    if (key == "general.architecture") continue;               // for other tools
    if (key == "vla.checksum") continue;                       // the writer of the test adds it
    if (key == kActionSteps || key == kCameraSizes) continue;  // what a checkpoint need not say
    CAPTURE(key);
    EditableBundle bundle = sound;
    bundle.remove_key(key);
    const auto engine = Engine::load(bundle.write("changed.gguf"), {.n_thread = 1, .dry = true});
    CHECK_FALSE(engine.ok());
    ++n_checked;
  }
  CHECK(n_checked > 40);
}

TEST_CASE("sizes that do not go together are refused before memory is taken") {
  for (const auto& [key, value] :
       std::initializer_list<std::pair<const char*, std::int64_t>>{{"lm.n_layer", 2000000000},
                                                                   {"lm.n_layer", 0},
                                                                   {"vision.patch_size", 65536},
                                                                   {"lm.n_head", 0},
                                                                   {"lm.n_head_kv", 5},
                                                                   {"policy.horizon", 1000000},
                                                                   {"policy.horizon", 0},
                                                                   {"solver.steps", 0},
                                                                   {"solver.steps", 1000000000},
                                                                   {"connector.factor", 3},
                                                                   {"vision.image_size", 8},
                                                                   {"lm.n_vocab", 1},
                                                                   {"policy.d_state", -1}}) {
    CAPTURE(key);
    CAPTURE(value);
    EditableBundle bundle = sound_bundle();
    bundle.set(key, Value(value));
    CHECK_FALSE(Engine::load(bundle.write("changed.gguf"), {.n_thread = 1}).ok());
  }
}

TEST_CASE("TurboVLA is refused with fewer cameras than views, fewer positions than tokens, or norms behind the sums") {
  const EditableBundle sound = EditableBundle::read(golden_path("turbovla/two_views") + "/bundle.gguf");
  const auto with_rows = [&](const char* key, const std::string& table, std::int64_t n) {
    EditableBundle bundle = sound;
    bundle.set(key, Value(n));
    auto& tensor = bundle.tensor(table);
    tensor.data.resize(tensor.data.size() / static_cast<std::size_t>(tensor.shape[1]) * static_cast<std::size_t>(n));
    tensor.shape[1] = n;
    return bundle;
  };
  check_refused(with_rows("policy.n_view", "camera.weight", 1), Code::bad_bundle, "policy.n_view: expected 2 or more");
  check_refused(with_rows("lm.n_position", "lm.position.weight", 31), Code::bad_bundle, "at most 31 tokens");
  EditableBundle bundle = sound;
  bundle.set("transformer.norm", Value(std::string("after")));
  check_refused(bundle, Code::bad_bundle, "transformer.norm");
}

TEST_CASE("TurboVLA of its authors is refused with other views, fewer rows than tokens, or odd heads") {
  const EditableBundle sound = EditableBundle::read(golden_path("turbovla_authors/two_views") + "/bundle.gguf");
  const auto with = [&](const char* key, const Value& value) {
    EditableBundle bundle = sound;
    bundle.set(key, value);
    return bundle;
  };
  check_refused(with("policy.n_row", Value(std::int64_t{27})), Code::bad_bundle, "1 to 27 tokens");
  check_refused(with("fusion.n_head", Value(std::int64_t{5})), Code::bad_bundle, "fusion.n_head");
  check_refused(with("policy.text_end", Value(std::int64_t{117})), Code::bad_bundle, "policy.text_end");
  check_refused(with("policy.padding", Value(std::string("none"))), Code::bad_bundle, "policy.padding");
  check_refused(with("policy.vision_tokens", Value(std::string("last_block"))), Code::bad_bundle,
                "vision.post_norm.weight");
  check_refused(with("policy.places", Value(std::string("patches"))), Code::bad_bundle, "place_scale.weight");
}

TEST_CASE(
    "VLA-JEPA is refused where its prompt has no room for the embodied tokens, or tensors belong to another head") {
  const EditableBundle sound = EditableBundle::read(golden_path("vla_jepa/libero") + "/bundle.gguf");
  const auto with = [&](const char* key, std::int64_t value) {
    EditableBundle bundle = sound;
    bundle.set(key, Value(value));
    return bundle;
  };
  check_refused(with("policy.n_embodied", 4000), Code::bad_bundle, "tokens or more, for the views");
  check_refused(with("policy.n_future", 7), Code::bad_bundle, "wrong shape     future.weight");
  check_refused(with("policy.d_state", 0), Code::bad_bundle, "expected 0 numbers at the end (policy.d_state)");
}

TEST_CASE("VLA-JEPA refuses instructions that its prompt has no place for, and frames of another camera") {
  const GoldenCase golden = GoldenCase::read(golden_path("vla_jepa/camera"));
  const auto engine = load_engine(golden.bundle());
  const auto refused = [&](const Observation& bad) {
    const auto chunk = engine->act(bad, golden.noise);
    REQUIRE_FALSE(chunk.ok());
    CHECK(chunk.error().code == Code::bad_observation);
    CHECK(engine->act(golden.observation, golden.noise).ok());
    return chunk.error().message();
  };
  for (const char* token : {"<|embodied_action|>", "<|image_pad|>", "<|video_pad|>", "<|placeholder|>"}) {
    Observation bad = golden.observation;
    bad.text = std::string("go ") + token;
    CHECK(refused(bad).find(std::string("instruction: expected text without ") + token) != std::string::npos);
  }
  Observation bad = golden.observation;
  for (int i = 0; i < 2000; ++i) *bad.text += " go";
  CHECK(refused(bad).find("shorten the instruction") != std::string::npos);
  bad = golden.observation;
  bad.views["front"] = Frame{36, 48, std::get<std::vector<std::uint8_t>>(bad.views["front"]->rgb)};
  CHECK(refused(bad).find("front: expected an image of 48 x 36, found 36 x 48") != std::string::npos);
}

TEST_CASE(
    "X-VLA is refused with fewer places than views, fewer positions than tokens, or a gripper that is no column") {
  const EditableBundle sound = EditableBundle::read(golden_path("xvla/two_views") + "/bundle.gguf");
  const auto with = [&](const char* key, Value value) {
    EditableBundle bundle = sound;
    bundle.set(key, std::move(value));
    return bundle;
  };
  const auto number = [](std::int64_t n) { return Value(n); };
  check_refused(with("policy.n_view", number(1)), Code::bad_bundle, "policy.n_view: expected 2 or more");
  check_refused(with("policy.n_view", number(32)), Code::bad_bundle, "transformer.n_position: expected 185 or more");
  check_refused(with("policy.n_token", number(80)), Code::bad_bundle, "lm.n_position: expected 85 or more");
  check_refused(with("policy.grippers", Value(std::vector<std::int64_t>{9, 20})), Code::bad_bundle, "policy.grippers");
  check_refused(with("vision.n_group", Value(std::vector<std::int64_t>{3, 2, 5})), Code::bad_bundle, "vision.n_group");
  check_refused(with("vision.n_head", Value(std::vector<std::int64_t>{2, 4})), Code::bad_bundle, "vision.n_head");
  check_refused(with("vision.patch_size", Value(std::vector<std::int64_t>{7, 3, 4})), Code::bad_bundle, "odd numbers");
  check_refused(with("vision.image_width", number(36)), Code::unsupported, "images of 36 x 32");
}

TEST_CASE("every number of every architecture has a range, and one beyond it is refused by its key") {
  std::size_t n_checked = 0;
  const std::vector<std::string> all = golden_bundles(), some = some_of(all);
  for (const std::string& path : some) {
    EditableBundle bundle = EditableBundle::read(path);
    const Keys sound = bundle.keys;
    for (const auto& [key, value] : sound.all())
      for (const Value& wrong : absurd(value)) {
        if (key == "action_tokens.min_token" && wrong == Value(-1000.0)) continue;  // of 3000 coefficients
        bundle.keys = sound;
        bundle.set(key, wrong);
        const auto engine = Engine::load(bundle.write("changed.gguf"), {.n_thread = 1, .dry = true});
        CHECK_MESSAGE(!engine.ok(), path << " " << key << " value " << n_checked);
        if (!engine) CHECK_MESSAGE(engine.error().message().find(key) != std::string::npos, engine.error().message());
        ++n_checked;
      }
  }
  CHECK(n_checked * all.size() > 500 * some.size());
}

TEST_CASE("statistics that the recipe does not read are an unused tensor") {
  EditableBundle bundle = sound_bundle();
  bundle.tensors.push_back({"stats.gripper.mean", DType::f32, {1}, std::string(4, '\0')});
  check_refused(bundle, Code::bad_bundle, "unused tensor   stats.gripper.mean");
}

TEST_CASE("statistics that are missing refuse the bundle instead of passing numbers through") {
  EditableBundle bundle = sound_bundle();
  bundle.erase("stats.observation.state.std");
  check_refused(bundle, Code::bad_bundle, "stats.observation.state.std");
}

TEST_CASE("a zero standard deviation divides by eps alone, as the reference does, and un-normalizes to the mean") {
  EditableBundle bundle = sound_bundle();
  for (const char* name : {"stats.observation.state.std", "stats.action.std"})
    std::memset(bundle.tensor(name).data.data(), 0, 4);
  GoldenCase golden = GoldenCase::read(kCase);
  float state_mean, action_mean;
  std::memcpy(&state_mean, bundle.tensor("stats.observation.state.mean").data.data(), 4);
  std::memcpy(&action_mean, bundle.tensor("stats.action.mean").data.data(), 4);
  golden.observation.states["state"][0] = state_mean;
  const auto chunk = load_engine(bundle.write("zero_std.gguf"), "state")->act(golden.observation, golden.noise);
  REQUIRE_MESSAGE(chunk.ok(), (chunk ? "" : chunk.error().message()));
  CHECK(find_tap(chunk->taps, "state").values[0] == 0.0f);
  for (int row = 0; row < chunk->horizon; ++row)
    CHECK(chunk->actions[static_cast<std::size_t>(row * chunk->d_action)] == action_mean);
}

TEST_CASE("wrong views, counts and numbers are refused by name, and the next request is answered") {
  const GoldenCase golden = GoldenCase::read(kCase);
  Observation bad = golden.observation;
  bad.views.erase("camera2");
  check_observation_refused(bad, golden.noise, Code::bad_observation, "camera2");
  bad = golden.observation;
  bad.views["camera9"] = bad.views["camera1"];
  check_observation_refused(bad, golden.noise, Code::bad_observation, "camera9");
  bad = golden.observation;
  bad.views["camera1"] = bad.views["camera2"] = std::nullopt;
  check_observation_refused(bad, golden.noise, Code::bad_observation, "at least 1");
  bad = golden.observation;
  bad.states["state"].pop_back();
  check_observation_refused(bad, golden.noise, Code::bad_observation, "state");
  bad = golden.observation;
  bad.states["state"][2] = std::numeric_limits<float>::quiet_NaN();
  check_observation_refused(bad, golden.noise, Code::bad_observation, "nan");
  bad = golden.observation;
  bad.text.reset();
  check_observation_refused(bad, golden.noise, Code::bad_observation, "instruction");
  bad.text = std::string(100000, 'a');
  check_observation_refused(bad, golden.noise, Code::bad_observation, "instruction");
}

TEST_CASE("noise of another size, or that is not finite, is refused") {
  const GoldenCase golden = GoldenCase::read(kCase);
  std::vector<float> noise = golden.noise;
  noise.pop_back();
  check_observation_refused(golden.observation, noise, Code::bad_observation, "noise");
  noise.push_back(std::numeric_limits<float>::infinity());
  check_observation_refused(golden.observation, noise, Code::bad_observation, "noise");
}

TEST_CASE("an action that is not finite never leaves the engine") {
  const GoldenCase golden = GoldenCase::read(kCase);
  check_observation_refused(golden.observation, std::vector<float>(golden.noise.size(), 3e38f), Code::bad_action, "");
}

TEST_CASE("a seed gives the same bytes every time and another seed others") {
  const GoldenCase golden = GoldenCase::read(kCase);
  const auto engine = load_engine(golden.bundle());
  const auto first = engine->act(golden.observation, std::uint64_t{7});
  CHECK(first->actions == engine->act(golden.observation, std::uint64_t{7})->actions);
  CHECK(first->actions != engine->act(golden.observation, std::uint64_t{8})->actions);
}

}  // namespace refusal_test
