// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Ops of a policy with places for views in its prompt: Evo-1.
#include "processor/sample.h"

namespace evo1_recipe_test {

using namespace vla;
using namespace vla::test;
using Json = nlohmann::json;

namespace {

constexpr const char* kRecipe = R"({
  "image":  [{"op": "resize", "width": 4, "height": 2, "filter": "opencv_bilinear"},
             {"op": "standardize", "mean": [0.5, 0.25, 0.0], "std": [0.5, 0.25, 1.0], "arithmetic": "bfloat16"}],
  "text":   [{"op": "strip"}, {"op": "views", "count": 3, "open": "Image-{i}: <img>", "token": "<IMG_CONTEXT>",
              "repeat": 5, "close": "</img>\n"}, {"op": "tokenize", "max_tokens": 64, "truncate": "right"}],
  "state":  [{"op": "normalize", "kind": "evo1_min_max", "stats": "stats.observation.state", "eps": 1e-08},
             {"op": "clip", "low": -1.0, "high": 1.0}, {"op": "pad", "size": 4, "value": -1.0}],
  "action": [{"op": "unnormalize", "kind": "evo1_min_max", "stats": "stats.action", "eps": 1e-08}, {"op": "take", "size": 2},
             {"op": "threshold", "columns": [1], "above": 0.5, "then": -1.0, "else": 1.0}]})";

EditableBundle evo1(const Json& recipe = Json::parse(kRecipe)) {
  EditableBundle bundle = sample();
  const Keys qwen = tokenizer_keys("qwen");
  for (const auto& [key, value] : qwen.all()) bundle.set(key, value);
  bundle.set("processor.recipe", recipe.dump());
  bundle.set("observation.max_text_tokens", std::int64_t{64});
  bundle.set("observation.view_optional", std::vector<std::int64_t>{1, 1, 1});
  bundle.set("observation.min_views", std::int64_t{1});
  bundle.set("policy.view_starts", std::vector<std::int64_t>{9, 25, 41});
  for (const char* kind : {"observation.state", "action"}) {
    const std::string name = std::string("stats.") + kind;
    const std::size_t width = name == "stats.action" ? 4 : 2;
    bundle.erase(name + ".mean");
    bundle.erase(name + ".std");
    add_stats(bundle, name + ".min", std::vector<float>(width, -1.0f));
    add_stats(bundle, name + ".max", std::vector<float>(width, 3.0f));
  }
  return bundle;
}

Json with(const char* pointer, const Json& value) {
  Json recipe = Json::parse(kRecipe);
  recipe[Json::json_pointer(pointer)] = value;
  return recipe;
}

std::string refused(const Json& recipe) { return refusal(parse_recipe(recipe.dump()), Code::bad_bundle); }

std::string refused_text(const Processor& processor, const std::string& text) {
  Observation seen = observation();
  seen.text = text;
  return refusal(processor.encode(seen), Code::bad_observation);
}

}  // namespace

TEST_CASE("a prompt with places for views has the reference's tokens") {
  const Processor processor = make(evo1());
  int compared = 0;
  for (const Json& text_and_ids : data_json("views.json")) {
    Observation seen = observation();
    seen.text = text_and_ids[0];
    CAPTURE(*seen.text);
    const auto inputs = processor.encode(seen);
    REQUIRE_MESSAGE(inputs.ok(), inputs.error().message());
    CHECK(inputs->tokens == std::vector<std::int32_t>(text_and_ids.begin() + 1, text_and_ids.end()));
    ++compared;
  }
  CHECK(compared == 7);
}

TEST_CASE("an instruction that holds the token of a place is refused") {
  const Processor processor = make(evo1());
  CHECK(contains(refused_text(processor, "pick <IMG_CONTEXT> up"), "instruction: expected text without <IMG_CONTEXT>"));
  CHECK(contains(refused_text(processor, "<IMG_CONTEXT>"), "instruction"));
}

TEST_CASE("a long instruction is cut behind the places, and one that would cut them is refused") {
  Observation seen = observation();
  for (int i = 0; i < 30; ++i) *seen.text += " pick up the cube";
  const auto inputs = make(evo1()).encode(seen);
  REQUIRE_MESSAGE(inputs.ok(), inputs.error().message());
  CHECK(inputs->tokens.size() == 64);
  CHECK(inputs->notes.size() == 1);
  CHECK(contains(refused_text(make(evo1(with("/text/2/truncate", "left"))), *seen.text), "the places of the views"));
}

TEST_CASE("an instruction of 64 KiB fits behind the places and a longer one is refused") {
  Observation seen = observation();
  seen.text = std::string(Tokenizer::kMaxText, 'a');
  CHECK(make(evo1()).encode(seen).ok());
  CHECK(contains(refused_text(make(evo1()), *seen.text + "a"), "at most 65536 bytes"));
}

TEST_CASE("places that are not where the bundle says are refused") {
  EditableBundle bundle = evo1();
  bundle.set("policy.view_starts", std::vector<std::int64_t>{9, 25, 42});
  CHECK(contains(refusal(create(bundle), Code::bad_bundle),
                 "policy.view_starts: expected 9, 25, 41, where the prompt has them, found 9, 25, 42"));
  bundle.remove_key("policy.view_starts");
  CHECK(contains(refusal(create(bundle), Code::bad_bundle), "policy.view_starts"));
  const auto refused_at = [](const char* pointer, const Json& value) {
    return refusal(create(evo1(with(pointer, value))), Code::bad_bundle);
  };
  CHECK(contains(refused_at("/text/1/token", "no token"), "processor.recipe.text[1].token"));
  CHECK(contains(refused_at("/text/1/open", "<IMG_CONTEXT>{i}"), "3 runs of 5 tokens"));
  CHECK(contains(refused_at("/text/2/max_tokens", 45), "at least 46 tokens"));
  CHECK(create(evo1(with("/text/2/max_tokens", 46))).ok());
}

TEST_CASE("the views that are present are told by their place in the bundle's order") {
  Observation seen = observation();
  seen.views = {{"side", grey(0)}};
  const auto inputs = make(evo1()).encode(seen);
  REQUIRE_MESSAGE(inputs.ok(), inputs.error().message());
  CHECK(inputs->views == 4);
  CHECK(inputs->n_view == 1);
  CHECK(make(evo1()).encode(observation())->views == 3);
}

TEST_CASE("an absent view is a black frame under the whole recipe") {
  const Processor processor = make(evo1());
  Observation seen = observation();
  seen.views = {{"side", Frame{4, 2, std::vector<std::uint8_t>(24)}}};
  CHECK(processor.absent_view() == processor.encode(seen)->pixels);
  CHECK(processor.absent_view().front() == -1.0f);
  CHECK(processor.absent_view().back() == 0.0f);
}

TEST_CASE("a state is clipped after its normalization and padded with the recipe's number") {
  Observation seen = observation();
  seen.states["state"] = {2.0f, 7.0f};
  const auto inputs = make(evo1()).encode(seen);
  REQUIRE_MESSAGE(inputs.ok(), inputs.error().message());
  CHECK(inputs->state == std::vector<float>{0.5f, 1.0f, -1.0f, -1.0f});
  CHECK(inputs->raw_state == std::vector<float>{2.0f, 7.0f});
  Json recipe = Json::parse(kRecipe);
  recipe["state"][2].erase("value");
  CHECK(make(evo1(recipe)).encode(seen)->state == std::vector<float>{0.5f, 1.0f, 0.0f, 0.0f});
}

TEST_CASE("a threshold decides in world units, and what is no number is refused before it") {
  const Processor processor = make(evo1());
  const std::vector<float> raw = {0.0f, 0.0f};
  CHECK(*processor.decode(std::vector<float>{0.0f, 0.0f, 9, 9}, 1, 4, raw) == std::vector<float>{1.0f, -1.0f});
  CHECK(*processor.decode(std::vector<float>{1.0f, -0.25f, 9, 9}, 1, 4, raw) == std::vector<float>{3.0f, 1.0f});
  CHECK(contains(refusal(processor.decode(std::vector<float>{0, NAN, 0, 0}, 1, 4, raw), Code::bad_action), "gripper"));
  CHECK(contains(refusal(create(evo1(with("/action/2/columns", Json{2}))), Code::bad_bundle),
                 "processor.recipe.action[2].columns"));
}

TEST_CASE("more views than a mask has bits are refused") {
  EditableBundle bundle = sample();
  std::vector<std::string> names;
  for (int i = 0; i < 65; ++i) names.push_back("observation.images." + std::to_string(i));
  bundle.set("observation.views", names);
  bundle.set("observation.view_aliases", std::vector<std::string>(65));
  bundle.set("observation.view_optional", std::vector<std::int64_t>(65));
  CHECK(contains(refusal(create(bundle), Code::bad_bundle), "observation.views: expected at most 64 views, found 65"));
}

TEST_CASE("every field of these ops but the number of a pad is required") {
  int removed = 0;
  const Json whole = Json::parse(kRecipe);
  for (const auto& list : whole.items())
    for (std::size_t i = 0; i < list.value().size(); ++i)
      for (const auto& field : list.value()[i].items()) {
        Json recipe = whole;
        recipe[list.key()][i].erase(field.key());
        if (field.key() == "value") continue;
        CHECK(contains(refused(recipe), list.key() + "[" + std::to_string(i) + "]." + field.key()));
        ++removed;
      }
  CHECK(removed == 38);
}

TEST_CASE("values that have no meaning to these ops are refused") {
  CHECK(contains(refused(with("/image/0/filter", "lanczos")), "\"opencv_bilinear\", \"torch_bicubic_8bit\""));
  CHECK(contains(refused(with("/image/0/width", 1)), "processor.recipe.image[0].width"));
  for (const Json& mean : {Json(0.5), Json{0.5, 0.5}, Json{0.5, 0.5, "a"}, Json{0.5, 0.5, 1e39}})
    CHECK(contains(refused(with("/image/1/mean", mean)), "image[1].mean: expected a list of 3 numbers"));
  CHECK(contains(refused(with("/image/1/std/1", 0.0)), "processor.recipe.image[1].std"));
  CHECK(contains(refused(with("/image/1/arithmetic", "float16")), "processor.recipe.image[1].arithmetic"));
  for (const char* open : {"{i}{i}", "{i} {", "{i} {n}"})
    CHECK(contains(refused(with("/text/1/open", open)), "processor.recipe.text[1].open"));
  CHECK(contains(refused(with("/text/1/token", "")), "processor.recipe.text[1].token"));
  CHECK(contains(refused(with("/text/1/count", 65)), "processor.recipe.text[1].count"));
  CHECK(contains(refused(with("/text/1/repeat", 60000)), "processor.recipe.text[1].repeat"));
  CHECK(contains(refused(with("/state/1/high", -2.0)), "processor.recipe.state[1].high"));
  CHECK(contains(refused(with("/state/2/value", "0")), "processor.recipe.state[2].value"));
}

TEST_CASE("these ops in an order that has no meaning are refused") {
  const auto swapped = [](const char* list, std::size_t i) {
    Json recipe = Json::parse(kRecipe);
    std::swap(recipe[list][i], recipe[list][i + 1]);
    return refused(recipe);
  };
  CHECK(contains(swapped("image", 0), "processor.recipe.image[0].op: expected a letterbox or a resize first"));
  CHECK(contains(swapped("text", 0), "processor.recipe.text[1].op: expected tokenize after views"));
  CHECK(contains(swapped("state", 0), "processor.recipe.state[0].op: expected one clip, after normalize"));
  Json recipe = Json::parse(kRecipe);
  recipe["state"].insert(recipe["state"].begin() + 2, recipe["state"][1]);
  CHECK(contains(refused(recipe), "processor.recipe.state[2].op: expected one clip, after normalize"));
  recipe["state"][2] = recipe["state"][0];
  CHECK(contains(refused(recipe), "processor.recipe.state[2].op: expected normalize before clip"));
  recipe["state"][2] = Json::parse(R"({"op": "affine", "columns": [0], "scale": 1.0, "shift": 0.0})");
  CHECK(contains(refused(recipe), "processor.recipe.state[2].op: expected the robot's conventions before normalize"));
}

}  // namespace evo1_recipe_test
