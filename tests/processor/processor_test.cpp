// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/processor.h"

#include <cmath>
#include <cstring>
#include <limits>

#include "processor/constant_actions.h"
#include "processor/sample.h"

namespace processor_test {

using namespace vla;
using namespace vla::test;
using Json = nlohmann::json;

namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
const std::vector<float> kRawState = {1.5f, 6.0f};
constexpr float kInf = std::numeric_limits<float>::infinity();

std::string refused(const Observation& bad) { return refusal(make().encode(bad), Code::bad_observation); }

/// The refusal of a bundle whose recipe has one value replaced.
std::string refused_recipe(const char* pointer, const Json& value) {
  Json recipe = Json::parse(*sample().keys.string("processor.recipe"));
  recipe[Json::json_pointer(pointer)] = value;
  return refused_with("processor.recipe", recipe.dump());
}

}  // namespace

TEST_CASE("an observation becomes pixels, tokens and a padded state") {
  const auto inputs = make().encode(observation());
  REQUIRE_MESSAGE(inputs.ok(), inputs.error().message());
  CHECK(inputs->n_view == 2);
  CHECK(inputs->width == 4);
  CHECK(inputs->height == 2);
  REQUIRE(inputs->pixels.size() == 2 * 24);
  CHECK(inputs->pixels.front() == -1.0f);
  CHECK(inputs->pixels.back() == 1.0f);
  CHECK(inputs->state == std::vector<float>{0.5f, 2.0f, 0.0f, 0.0f});
  CHECK(inputs->notes.empty());
  const auto ids = Tokenizer::create(tokenizer_keys("smol"), 4096)->encode("pick up\n");
  CHECK(inputs->tokens == *ids);
}

TEST_CASE("views go in the bundle's order under full name, last part or alias") {
  Observation seen = observation();
  seen.views = {{"hand", grey(51)}, {"observation.images.top", grey(102)}, {"side", grey(255)}};
  const auto inputs = make().encode(seen);
  REQUIRE(inputs.ok());
  CHECK(inputs->n_view == 3);
  CHECK(inputs->pixels[0] == 102.0f / 255.0f * 2.0f - 1.0f);
  CHECK(inputs->pixels[24] == 51.0f / 255.0f * 2.0f - 1.0f);
  CHECK(inputs->pixels[48] == 1.0f);
  seen.views.erase("hand");
  seen.views["observation.images.hand"] = grey(51);
  CHECK(make().encode(seen).ok());
}

TEST_CASE("inputs that are filled again keep their memory and drop what they held") {
  const Processor processor = make();
  Inputs inputs;
  Observation seen = observation();
  seen.text = "pick up the red cube and place it in the bowl";
  REQUIRE(processor.encode_images(seen, inputs).ok());
  REQUIRE(processor.encode_state(seen, inputs).ok());
  REQUIRE(processor.encode_text(seen, inputs).ok());
  CHECK(inputs.notes.size() == 1);
  const float* pixels = inputs.pixels.data();
  const float* state = inputs.state.data();
  REQUIRE(processor.encode_images(observation(), inputs).ok());
  REQUIRE(processor.encode_state(observation(), inputs).ok());
  REQUIRE(processor.encode_text(observation(), inputs).ok());
  CHECK(inputs.pixels.data() == pixels);
  CHECK(inputs.state.data() == state);
  CHECK(inputs.state.size() == 4);
  CHECK(inputs.notes.empty());
}

TEST_CASE("an image that no camera gives has a note") {
  const auto note_on = [](std::vector<std::uint8_t> rgb) {
    Observation seen = observation();
    seen.views["top"] = Frame{2, 1, std::move(rgb)};
    const auto notes = make().encode(seen)->notes;
    return notes.empty() ? std::string() : notes.front();
  };
  CHECK(contains(note_on({9, 8, 7, 9, 8, 7}), "observation.images.top: all pixels are alike"));
  CHECK(contains(note_on({1, 0, 1, 0, 0, 1}), "observation.images.top: all bytes are 0 or 1"));
  CHECK(note_on({1, 0, 1, 0, 0, 2}).empty());
  CHECK(note_on({9, 8, 7, 9, 8, 6}).empty());
  Observation seen = observation();
  seen.views["top"] = Frame{2, 1, std::vector<float>(6, 0.5f)};
  CHECK(contains(make().encode(seen)->notes.at(0), "all pixels are alike"));
}

TEST_CASE("actions whose statistics have no spread are known when a bundle is loaded") {
  CHECK(constant_actions(make(), 3, 4) == std::vector<std::string>{"gripper"});
  EditableBundle bundle = sample();
  bundle.erase("stats.action.std");
  add_stats(bundle, "stats.action.std", {2.0f, 0.001f});
  CHECK(constant_actions(make(bundle), 3, 4).empty());
}

TEST_CASE("views that are unknown, doubled, missing or too few are refused with the bundle's names") {
  Observation bad = observation();
  bad.views["front"] = grey(0);
  CHECK(contains(refused(bad), "view \"front\": expected one of observation.images.top, observation.images.wrist"));
  bad = observation();
  bad.views["hand"] = grey(0);
  CHECK(contains(refused(bad), "observation.images.wrist: expected one value, found a second one"));
  bad = observation();
  bad.views.erase("side");
  CHECK(contains(refused(bad), "observation.images.side: expected an image, or the view declared absent"));
  bad = observation();
  bad.views["wrist"] = std::nullopt;
  CHECK(contains(refused(bad), "expected at least 2 of the views"));
  bad = observation();
  bad.views[""] = grey(0);
  CHECK(contains(refused(bad), "no such view"));
}

TEST_CASE("an optional view that is not mentioned is absent") {
  EditableBundle bundle = sample();
  bundle.set("observation.view_optional", std::vector<std::int64_t>{0, 0, 1});
  Observation seen = observation();
  seen.views.erase("side");
  const auto inputs = make(bundle).encode(seen);
  REQUIRE(inputs.ok());
  CHECK(inputs->n_view == 2);
  seen.views["side"] = grey(0);
  CHECK(make(bundle).encode(seen)->n_view == 3);
  seen.views.erase("top");
  CHECK(contains(refusal(make(bundle).encode(seen), Code::bad_observation), "observation.images.top"));
}

TEST_CASE("a name that two views share must be given in full") {
  EditableBundle bundle = sample();
  bundle.set("observation.views", std::vector<std::string>{"left.top", "right.top", "side"});
  const Processor processor = make(bundle);
  Observation seen = observation();
  seen.views = {{"top", grey(0)}, {"right.top", grey(0)}, {"side", grey(0)}};
  CHECK(contains(refusal(processor.encode(seen), Code::bad_observation), "give the full name"));
  seen.views = {{"left.top", grey(0)}, {"right.top", grey(0)}, {"side", grey(0)}};
  CHECK(processor.encode(seen).ok());
}

TEST_CASE("a whole name goes before a last part") {
  EditableBundle bundle = sample();
  bundle.set("observation.views", std::vector<std::string>{"top", "right.top", "side"});
  Observation seen = observation();
  seen.views = {{"top", grey(0)}, {"right.top", grey(255)}, {"side", std::nullopt}};
  const auto inputs = make(bundle).encode(seen);
  REQUIRE(inputs.ok());
  CHECK(inputs->pixels.front() == -1.0f);
}

TEST_CASE("frames that are damaged or leave no pixel are refused by their view") {
  Observation bad = observation();
  bad.views["wrist"] = Frame{4, 2, std::vector<std::uint8_t>(23)};
  CHECK(contains(refused(bad), "observation.images.wrist: "));
  bad.views["wrist"] = Frame{1, 2, std::vector<float>{0, 0, 0, 0, 0, kNaN}};
  CHECK(contains(refused(bad), "observation.images.wrist: expected float pixels in [0, 1]"));
  bad.views["wrist"] = Frame{100, 1, std::vector<std::uint8_t>(300)};
  CHECK(contains(refused(bad), "observation.images.wrist: "));
}

TEST_CASE("states that are missing, unknown, of another width or not finite are refused") {
  Observation bad = observation();
  bad.states.clear();
  CHECK(contains(refused(bad), "observation.state: expected 2 numbers, found nothing"));
  bad = observation();
  bad.states["gripper"] = {0.0f};
  CHECK(contains(refused(bad), "state \"gripper\": expected one of observation.state"));
  bad = observation();
  bad.states["observation.state"] = {0.0f, 0.0f};
  CHECK(contains(refused(bad), "a second one"));
  for (const std::vector<float>& wrong : {std::vector<float>{}, {1.0f}, {1.0f, 2.0f, 3.0f}}) {
    bad = observation();
    bad.states["state"] = wrong;
    CHECK(contains(refused(bad), "observation.state: expected 2 numbers, found " + std::to_string(wrong.size())));
  }
  for (const float wrong : {kNaN, kInf, -kInf}) {
    bad = observation();
    bad.states["state"] = {0.0f, wrong};
    CHECK(contains(refused(bad), "observation.state[1]: expected a finite number"));
  }
}

TEST_CASE("a state that overflows when normalized is refused") {
  EditableBundle bundle = sample();
  bundle.tensor("stats.observation.state.std").data = std::string(8, '\0');
  Json recipe = Json::parse(*bundle.keys.string("processor.recipe"));
  recipe["state"][0]["eps"] = 1e-30;
  bundle.set("processor.recipe", recipe.dump());
  Observation bad = observation();
  bad.states["state"] = {3e38f, 0.0f};
  CHECK(contains(refusal(make(bundle).encode(bad), Code::bad_observation), "state[0]"));
}

TEST_CASE("several states are concatenated in order and normalized by feature") {
  EditableBundle bundle = sample();
  bundle.set("observation.states", std::vector<std::string>{"observation.state", "observation.gripper"});
  bundle.set("observation.state_dims", std::vector<std::int64_t>{2, 1});
  bundle.set("observation.state_names", std::vector<std::string>{"x", "y", "grip"});
  bundle.set("observation.state_units", std::vector<std::string>{"m", "", ""});
  Json recipe = Json::parse(*bundle.keys.string("processor.recipe"));
  recipe["state"][0]["feature"] = "observation.state";
  bundle.set("processor.recipe", recipe.dump());
  Observation seen = observation();
  seen.states["gripper"] = {7.0f};
  const auto inputs = make(bundle).encode(seen);
  REQUIRE(inputs.ok());
  CHECK(inputs->state == std::vector<float>{0.5f, 2.0f, 7.0f, 0.0f});
  recipe["state"][0].erase("feature");
  bundle.set("processor.recipe", recipe.dump());
  CHECK(contains(refusal(create(bundle), Code::bad_bundle), "processor.recipe.state[0].feature"));
}

TEST_CASE("a chunk becomes actions in world units") {
  const std::vector<float> chunk = {0.5f, 9.0f, kNaN, kNaN, -1.0f, 3.0f, kNaN, kNaN};  // padded columns do not matter
  const auto actions = make().decode(chunk, 2, 4, kRawState);
  REQUIRE_MESSAGE(actions.ok(), actions.error().message());
  CHECK(*actions == std::vector<float>{11.0f, 20.0f, 8.0f, 20.0f});
}

TEST_CASE("an action that is not finite is refused by row and name") {
  std::vector<float> chunk(8, 0.0f);
  chunk[5] = kInf;
  CHECK(contains(refusal(make().decode(chunk, 2, 4, kRawState), Code::bad_action),
                 "actions[1][\"gripper\"]: expected a finite number"));
  chunk[5] = 0.0f;
  chunk[0] = 3e38f;  // finite, but not in world units
  CHECK(contains(refusal(make().decode(chunk, 2, 4, kRawState), Code::bad_action), "actions[0][\"shoulder\"]"));
}

TEST_CASE("a chunk of another shape is our own mistake") {
  const std::vector<float> chunk(8);
  for (const auto& [horizon, d_action] : {std::pair{2, 3}, {3, 4}, {0, 4}, {-2, -4}, {4, 2}})
    refusal(make().decode(chunk, horizon, d_action, kRawState), Code::internal);
}

TEST_CASE("every key that the processor reads or that describes its features is required") {
  for (const char* key :
       {"processor.recipe", "observation.views", "observation.view_aliases", "observation.view_optional",
        "observation.min_views", "observation.states", "observation.state_dims", "observation.max_text_tokens",
        "observation.state_names", "observation.state_units", "action.names", "action.units", "action.rate_hz",
        "tokenizer.tokens", "lm.n_vocab", "policy.d_state", "policy.d_action"}) {
    EditableBundle bundle = sample();
    bundle.remove_key(key);
    CHECK(contains(refusal(create(bundle), Code::bad_bundle), key));
  }
}

TEST_CASE("features that do not fit each other are refused") {
  CHECK(contains(refused_with("observation.views", std::vector<std::string>{"a", "a", "b"}), "observation.views"));
  CHECK(contains(refused_with("observation.views", std::vector<std::string>{"a", "", "b"}), "observation.views"));
  CHECK(contains(refused_with("observation.view_aliases", std::vector<std::string>{"a"}), "3 entries"));
  CHECK(contains(refused_with("observation.view_optional", std::vector<std::int64_t>{0}), "3 entries"));
  CHECK(contains(refused_with("observation.view_optional", std::vector<std::int64_t>{0, 0, 2}), "0 to 1"));
  CHECK(contains(refused_with("observation.min_views", std::int64_t{0}), "1 to 3"));
  CHECK(contains(refused_with("observation.min_views", std::int64_t{4}), "1 to 3"));
  CHECK(contains(refused_with("observation.state_dims", std::vector<std::int64_t>{2, 1}), "observation.state_dims"));
  CHECK(contains(refused_with("observation.state_dims", std::vector<std::int64_t>{0}), "observation.state_dims"));
  CHECK(contains(refused_with("observation.state_dims", std::vector<std::int64_t>{3}), "3 numbers"));
  CHECK(contains(refused_with("observation.state_units", std::vector<std::string>{}), "observation.state_units"));
  CHECK(contains(refused_with("action.rate_hz", -1.0), "action.rate_hz"));
  CHECK(contains(refused_recipe("/state/1/size", 1), "processor.recipe.state[1].size: expected at least the 2"));
  CHECK(contains(refused_with("observation.max_text_tokens", std::int64_t{7}), "observation.max_text_tokens"));
  CHECK(contains(refused_with("action.names", std::vector<std::string>{"one"}), "action.names"));
  CHECK(contains(refused_recipe("/action", Json::array()), "action.names: expected one name for each of the 4"));
  CHECK(contains(refused_with("policy.d_state", std::int64_t{5}), "policy.d_state"));
  CHECK(contains(refused_with("policy.d_action", std::int64_t{1}), "processor.recipe.action[0].size"));
}

TEST_CASE("statistics that are missing, not finite or of another length are refused") {
  EditableBundle bundle = sample();
  bundle.erase("stats.action.std");
  CHECK(contains(refusal(create(bundle), Code::bad_bundle), "stats.action.std"));
  bundle = sample();
  bundle.tensor("stats.action.std").data = std::string("\0\0\xc0\x7f\0\0\0\0", 8);
  CHECK(contains(refusal(create(bundle), Code::bad_bundle), "finite numbers"));
  for (const auto& [name, value] : {std::pair("std", -1.0f), std::pair("std", 1e38f), std::pair("mean", -1e38f)}) {
    bundle = sample();
    std::memcpy(bundle.tensor(std::string("stats.action.") + name).data.data(), &value, sizeof(value));
    CHECK(contains(refusal(create(bundle), Code::bad_bundle), std::string("stats.action.") + name + "[0]: expected"));
  }
  CHECK(contains(refused_recipe("/action/0/size", 1), "stats.action.mean: expected 1 numbers"));
  CHECK(contains(refused_recipe("/state/0/kind", "quantiles"), "stats.observation.state.q01"));
}

TEST_CASE("a column that is unnormalized twice is refused") {
  EditableBundle bundle = sample();
  Json recipe = Json::parse(*bundle.keys.string("processor.recipe"));
  recipe["action"].push_back(recipe["action"][1]);
  bundle.set("processor.recipe", recipe.dump());
  CHECK(contains(refusal(create(bundle), Code::bad_bundle), "processor.recipe.action[2]"));
}

TEST_CASE("a spread of zero without eps is refused where it would divide") {
  EditableBundle bundle = sample();
  bundle.tensor("stats.observation.state.std").data = std::string(8, '\0');
  CHECK(create(bundle).ok());
  Json recipe = Json::parse(*bundle.keys.string("processor.recipe"));
  recipe["state"][0]["eps"] = 0.0;
  recipe["action"][1]["eps"] = 0.0;
  bundle.set("processor.recipe", recipe.dump());
  CHECK(contains(refusal(create(bundle), Code::bad_bundle),
                 "stats.observation.state: expected a spread to divide by in column 0"));
}

TEST_CASE("of very many names a message lists the first fifty") {
  EditableBundle bundle = sample();
  std::vector<std::string> names, units;
  for (int i = 0; i < 20000; ++i) names.push_back("state.number_" + std::to_string(i)), units.emplace_back();
  Json recipe = Json::parse(*bundle.keys.string("processor.recipe"));
  recipe["state"] = {{{"op", "pad"}, {"size", 20000}}};
  bundle.set("processor.recipe", recipe.dump());
  for (const char* key : {"observation.states", "observation.state_names"}) bundle.set(key, names);
  bundle.set("observation.state_units", units);
  bundle.set("observation.state_dims", std::vector<std::int64_t>(names.size(), 1));
  bundle.set("policy.d_state", std::int64_t{20000});
  const std::string message = refusal(make(bundle).encode(observation()), Code::bad_observation);
  CHECK(contains(message, "state.number_49 and 19950 more"));
  CHECK(message.size() < 4096);
}

TEST_CASE("a state far beyond what the policy has seen is told by name, or refused where that is asked for") {
  Observation seen = observation();
  seen.states["state"] = {1.5f, 1e30f};
  const Processor processor = make();
  const auto inputs = processor.encode(seen);
  REQUIRE_MESSAGE(inputs.ok(), inputs.error().message());
  CHECK(inputs->out_of_range);
  REQUIRE(inputs->notes.size() == 1);
  CHECK(contains(inputs->notes[0],
                 "observation.state[1] (\"y\"): 1e+30, which is 5e+29 when normalized; more than 10 is far"));
  seen.states["state"] = {-20.0f, 1e30f};
  CHECK(contains(processor.encode(seen)->notes.at(0),
                 "observation.state[0] (\"x\"): -20, which is -21 when normalized, and 1 more"));
  seen.reject_out_of_range = true;
  CHECK(contains(refusal(processor.encode(seen), Code::bad_observation),
                 "observation.state[0] (\"x\"): expected at most 10 when normalized"));
  seen.states["state"] = {10.9f, -17.9f};  // 9.9 and -9.95 of 0.5 + 0.5 and 1.5 + 0.5
  CHECK(processor.encode(seen)->notes.empty());
  CHECK_FALSE(processor.encode(seen)->out_of_range);
  seen.reject_out_of_range = false;
  EditableBundle bundle = sample();
  bundle.set("observation.state_bound", 5.0);
  CHECK(make(bundle).encode(seen)->out_of_range);
}

TEST_CASE("a feature that passes unnormalized by permission is told with every answer") {
  EditableBundle bundle = sample();
  bundle.set("vla.degraded", std::vector<std::string>{"observation.state", "action"});
  const Processor processor = make(bundle);
  CHECK(processor.degraded().size() == 2);
  for (int i = 0; i < 2; ++i) {
    const auto notes = processor.encode(observation())->notes;
    REQUIRE(notes.size() == 2);
    CHECK(contains(notes[0], "DEGRADED: observation.state passes unnormalized"));
  }
  bundle.set("vla.degraded", std::vector<std::string>{"gripper"});
  CHECK(contains(refusal(create(bundle), Code::bad_bundle), "vla.degraded: expected action, observation.state"));
}

TEST_CASE("an op of one view leaves the pixels of the others alone") {
  EditableBundle bundle = sample();
  Json recipe = Json::parse(*bundle.keys.string("processor.recipe"));
  recipe["image"][1] = Json::parse(R"({"op": "standardize", "mean": [0.5, 0.5, 0.5], "std": [0.25, 0.25, 0.25],
                                       "arithmetic": "float32", "view": 1})");
  bundle.set("processor.recipe", recipe.dump());
  const auto inputs = make(bundle).encode(observation());
  REQUIRE_MESSAGE(inputs.ok(), inputs.error().message());
  CHECK(inputs->pixels.front() == 0.0f);
  CHECK(inputs->pixels.back() == 2.0f);
  recipe["image"][1]["view"] = 3;
  bundle.set("processor.recipe", recipe.dump());
  CHECK(contains(refusal(create(bundle), Code::bad_bundle), "processor.recipe.image: expected ops of the 3 views"));
}

}  // namespace processor_test
