// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/recipe.h"

#include "processor/ops/columns.h"
#include "processor/support.h"

namespace recipe_test {

using namespace vla;
using namespace vla::test;
using Json = nlohmann::json;

namespace {

/// The recipe that docs/bundle.md shows.
Json sample() {
  return Json::parse(R"({
    "image":  [{"op": "letterbox", "width": 512, "height": 384, "filter": "bilinear", "antialias": false,
                "align": "bottom_right", "fill": 0.5},
               {"op": "affine", "scale": 2.0, "shift": -1.0}],
    "text":   [{"op": "ensure_suffix", "suffix": "\n"}, {"op": "tokenize", "max_tokens": 48, "truncate": "right"}],
    "state":  [{"op": "normalize", "kind": "mean_std", "stats": "stats.observation.state", "eps": 1e-08},
               {"op": "pad", "size": 32}],
    "action": [{"op": "take", "size": 7}, {"op": "unnormalize", "kind": "min_max", "stats": "stats.action", "eps": 1e-08}]})");
}

std::string refused(const Json& recipe) { return refusal(parse_recipe(recipe.dump()), Code::bad_bundle); }

/// The refusal after one value of the sample is replaced.
std::string refused_at(const char* pointer, const Json& value) {
  Json recipe = sample();
  recipe[Json::json_pointer(pointer)] = value;
  return refused(recipe);
}

}  // namespace

TEST_CASE("the recipe of the document is read op by op") {
  const auto recipe = parse_recipe(sample().dump());
  REQUIRE(recipe.ok());
  CHECK(recipe->width == 512);
  CHECK(recipe->height == 384);
  std::vector<float> planes(3 * 512 * 384);
  REQUIRE(recipe->fit->apply(Frame{1, 2, std::vector<float>(6)}, 0, planes, "top").ok());
  CHECK(planes[0] == 0.5f);  // what a tall frame leaves at the left
  REQUIRE(recipe->image.size() == 1);
  recipe->image[0]->apply(planes, 0);
  CHECK(planes[0] == 0.0f);  // 2 x - 1
  REQUIRE(recipe->text.size() == 1);
  CHECK(*recipe->text[0]->apply("open", {}) == "open\n");
  CHECK(recipe->max_tokens == 48);
  REQUIRE(recipe->state.size() == 2);
  CHECK(recipe->state[0]->reads("stats.observation.state.mean"));
  CHECK(recipe->state[0]->reads("stats.observation.state.std"));
  CHECK_FALSE(recipe->state[0]->reads("stats.observation.state.min"));
  std::vector<float> state(6);
  std::vector<int> no_bins;
  CHECK(recipe->state[1]->finish(state, no_bins).ok());
  CHECK(state.size() == 32);
  REQUIRE(recipe->action.size() == 2);
  std::vector<double> row(32);
  recipe->action[0]->apply(row, {});
  CHECK(row.size() == 7);
  CHECK(recipe->action[1]->reads("stats.action.min"));
}

TEST_CASE("the ops of a list, and the text in them, are bounded") {
  Json recipe = sample();
  for (int i = 0; i < 64; ++i) recipe["text"].insert(recipe["text"].begin(), {{"op", "strip"}});
  CHECK(contains(refused(recipe), "processor.recipe.text: expected at most 64 ops, found 66"));
  const std::string longest(4096, 'x');
  CHECK(parse_recipe((recipe = sample(), recipe["text"][0]["suffix"] = longest, recipe.dump())).ok());
  CHECK(contains(refused_at("/text/0/suffix", longest + "x"), "at most 4096 bytes of text"));
}

TEST_CASE("every field that is missing is refused by its place") {
  const Json whole = sample();
  int removed = 0;
  for (const auto& list : whole.items()) {
    for (std::size_t i = 0; i < list.value().size(); ++i) {
      for (const auto& field : list.value()[i].items()) {
        Json recipe = whole;
        recipe[list.key()][i].erase(field.key());
        const std::string place = "processor.recipe." + list.key() + "[" + std::to_string(i) + "]." + field.key();
        CHECK(contains(refused(recipe), place));
        ++removed;
      }
    }
    Json recipe = whole;
    recipe.erase(list.key());
    CHECK(contains(refused(recipe), "processor.recipe." + list.key()));
  }
  CHECK(removed == 27);
}

TEST_CASE("every field of a wrong type is refused by its place") {
  const Json whole = sample();
  for (const auto& list : whole.items()) {
    for (std::size_t i = 0; i < list.value().size(); ++i) {
      for (const auto& field : list.value()[i].items()) {
        const std::string place = "processor.recipe." + list.key() + "[" + std::to_string(i) + "]." + field.key();
        for (const Json& wrong : {Json(nullptr), Json::array(), Json::object()}) {
          Json recipe = whole;
          recipe[list.key()][i][field.key()] = wrong;
          CHECK(contains(refused(recipe), place));
        }
      }
    }
  }
}

TEST_CASE("a document that nests without end is refused instead of exhausting the stack") {
  for (const char* bracket : {"[", "{\"a\":"}) {
    std::string deep;
    for (int i = 0; i < 300000; ++i) deep += bracket;
    const auto recipe = parse_recipe(deep);
    REQUIRE_FALSE(recipe.ok());
    CHECK(contains(recipe.error().message(), "deep"));
  }
}

TEST_CASE("values that the document does not name are refused") {
  CHECK(contains(refused_at("/image/0/op", "crop"), "processor.recipe.image[0].op"));
  CHECK(contains(refused_at("/image/0/filter", "bicubic"),
                 "processor.recipe.image[0].filter: expected \"bilinear\", found \"bicubic\""));
  CHECK(contains(refused_at("/image/0/antialias", 1), "processor.recipe.image[0].antialias"));
  CHECK(contains(refused_at("/image/0/align", "top"), "processor.recipe.image[0].align"));
  CHECK(contains(refused_at("/image/0/width", 0), "processor.recipe.image[0].width"));
  CHECK(contains(refused_at("/image/0/width", 512.0), "processor.recipe.image[0].width"));
  CHECK(contains(refused_at("/image/0/height", 1000000), "an integer from 1 to 8192"));
  CHECK(contains(refused_at("/image/0/height", 18446744073709551615u), "an integer from 1 to 8192"));
  CHECK(contains(refused_at("/image/1/scale", 1e300), "processor.recipe.image[1].scale"));
  CHECK(contains(refused_at("/text/1/truncate", "middle"), "processor.recipe.text[1].truncate"));
  CHECK(contains(refused_at("/state/0/kind", "robust"), "processor.recipe.state[0].kind"));
  CHECK(contains(refused_at("/state/0/eps", -1e-8), "processor.recipe.state[0].eps"));
  CHECK(contains(refused_at("/action/1/op", "normalize"), "processor.recipe.action[1].op"));
  CHECK(contains(refused_at("/action/1/feature", "action"), "processor.recipe.action[1].feature"));
}

TEST_CASE("fields and lists that the document does not name are refused") {
  CHECK(contains(refused_at("/image/0/gamma", 1), "processor.recipe.image[0].gamma: unknown field"));
  CHECK(contains(refused_at("/audio", Json::array()), "processor.recipe.audio: unknown field"));
  CHECK(contains(refused_at("/state/2", "pad"), "processor.recipe.state[2]: expected a JSON object"));
  CHECK(contains(refused_at("/image", 3), "processor.recipe.image: expected a list"));
}

TEST_CASE("ops in an order that has no meaning are refused") {
  Json recipe = sample();
  std::swap(recipe["image"][0], recipe["image"][1]);
  CHECK(contains(refused(recipe), "processor.recipe.image[0].op: expected a letterbox or a resize first"));
  recipe = sample();
  recipe["image"][1] = recipe["image"][0];
  CHECK(contains(refused(recipe), "processor.recipe.image[1].op"));
  recipe = sample();
  std::swap(recipe["text"][0], recipe["text"][1]);
  CHECK(contains(refused(recipe), "processor.recipe.text[1].op: expected nothing after tokenize"));
  recipe = sample();
  std::swap(recipe["state"][0], recipe["state"][1]);
  CHECK(contains(refused(recipe), "processor.recipe.state[1].op: expected nothing after pad"));
  CHECK(contains(refused_at("/image", Json::array({Json{{"op", "affine"}, {"scale", 1.0}, {"shift", 0.0}}})),
                 "processor.recipe.image[0].op: expected a letterbox or a resize first"));
  recipe = sample();
  recipe["image"] = Json::array();  // of a policy without views
  CHECK(parse_recipe(recipe.dump()).ok());
  recipe = sample();
  recipe["text"].erase(1);
  CHECK(contains(refused(recipe), "processor.recipe.text: expected tokenize"));
}

TEST_CASE("text that is not a JSON object is refused") {
  for (const char* text : {"", "{", "[]", "3", "{\"image\": []} x", "\xff"})
    CHECK(contains(refusal(parse_recipe(text), Code::bad_bundle), "processor.recipe"));
  CHECK(contains(refusal(parse_recipe(std::string(100000, '[')), Code::bad_bundle), "processor.recipe"));
}

TEST_CASE("an identity needs no statistics") {
  Json recipe = sample();
  recipe["state"][0] = {{"op", "normalize"}, {"kind", "identity"}};
  const auto parsed = parse_recipe(recipe.dump());
  REQUIRE(parsed.ok());
  std::vector<float> state = {1.0f, -2.0f};
  parsed->state.at(0)->apply(state);
  CHECK(state == std::vector<float>{1.0f, -2.0f});
}

namespace {

/// Every op that the sample lacks, in an order that has a meaning.
Json robot() {
  return Json::parse(R"({
    "image":  [{"op": "letterbox", "width": 224, "height": 224, "filter": "bilinear", "antialias": true,
                "align": "center", "fill": 0.0},
               {"op": "clip", "low": 0.0, "high": 1.0}],
    "text":   [{"op": "strip"}, {"op": "replace", "from": "_", "to": " "},
               {"op": "template", "text": "Task: {instruction}, State: {state};"},
               {"op": "tokenize", "max_tokens": 200, "truncate": "right"}],
    "state":  [{"op": "affine", "columns": [1, 2], "scale": -1.0, "shift": 0.25},
               {"op": "horn_angle", "columns": [6], "scale": 2.0, "shift": 0.5, "arm_length": 0.036, "horn_radius": 0.022},
               {"op": "normalize", "kind": "openpi_quantiles", "stats": "stats.observation.state", "eps": 1e-06},
               {"op": "bins", "low": -1.0, "high": 1.0, "count": 256}],
    "action": [{"op": "take", "size": 7}, {"op": "unnormalize", "kind": "openpi_mean_std", "stats": "stats.action", "eps": 1e-06},
               {"op": "add_state", "columns": [0, 1]}, {"op": "affine", "columns": [6], "scale": 0.5, "shift": 1.5}]})");
}

/// The refusal after one value of it is replaced.
std::string refused_robot(const char* pointer, const Json& value) {
  Json recipe = robot();
  recipe[Json::json_pointer(pointer)] = value;
  return refused(recipe);
}

}  // namespace

TEST_CASE("ops of robots and of prompts with a state are read") {
  const auto recipe = parse_recipe(robot().dump());
  REQUIRE_MESSAGE(recipe.ok(), recipe.error().message());
  std::vector<float> planes = {2.0f, -1.0f};
  recipe->image.at(0)->apply(planes, 0);
  CHECK(planes == std::vector<float>{1.0f, 0.0f});
  CHECK(*recipe->text.at(0)->apply(" a b ", {}) == "a b");
  CHECK(*recipe->text.at(1)->apply("a_b", {}) == "a b");
  CHECK(*recipe->text.at(2)->apply("go", std::vector<int>{3, -1}) == "Task: go, State: 3 -1;");
  std::vector<float> state(7, 1.0f), angle = {0, 0, 0, 0, 0, 0, 1.0f};
  recipe->state.at(0)->apply(state);
  CHECK(state == std::vector<float>{1, -0.75f, -0.75f, 1, 1, 1, 1});
  recipe->state.at(1)->apply(state);
  map_columns(HornAngle{{6}, 2.0, 0.5, 0.036, 0.022}, angle);
  CHECK(state[6] == angle[6]);
  CHECK(recipe->state.at(2)->reads("stats.observation.state.q99"));
  std::vector<float> normalized = {-2.0f, 0.0f, 2.0f};
  std::vector<int> discretized;
  CHECK(recipe->state.at(3)->finish(normalized, discretized).ok());
  CHECK(discretized == std::vector<int>{-1, 128, 255});
  CHECK(normalized.empty());
  std::vector<double> row(7, 1.0);
  recipe->action.at(2)->apply(row, {0, state});
  CHECK(row[1] == 0.25f);
  recipe->action.at(3)->apply(row, {0, state});
  CHECK(row[6] == 2.0f);
}

TEST_CASE("every field of the ops of robots is required") {
  int removed = 0;
  const Json whole = robot();
  for (const auto& list : whole.items())
    for (std::size_t i = 0; i < list.value().size(); ++i)
      for (const auto& field : list.value()[i].items()) {
        Json recipe = whole;
        recipe[list.key()][i].erase(field.key());
        CHECK(contains(refused(recipe), list.key() + "[" + std::to_string(i) + "]." + field.key()));
        ++removed;
      }
  CHECK(removed == 49);
}

TEST_CASE("values that have no meaning to a robot's op are refused") {
  for (const Json& columns :
       {Json(3), Json{1, 1}, Json{-1}, Json{0.5}, Json{"a"}, Json{65536}, Json{18446744073709551615u}})
    CHECK(contains(refused_robot("/state/0/columns", columns), "processor.recipe.state[0].columns"));
  CHECK(contains(refused_robot("/state/0/scale", "1"), "processor.recipe.state[0].scale"));
  CHECK(contains(refused_robot("/state/1/horn_radius", 0.0), "a number from 1e-09"));
  CHECK(contains(refused_robot("/state/3/high", -1.0), "processor.recipe.state[3].high"));
  CHECK(contains(refused_robot("/state/3/count", 0), "processor.recipe.state[3].count"));
  CHECK(contains(refused_robot("/image/1/low", 2.0), "processor.recipe.image[1].high"));
  CHECK(contains(refused_robot("/text/1/from", ""), "processor.recipe.text[1].from"));
}

TEST_CASE("a template has its places once and no other braces") {
  for (const char* text : {"", "{state}", "{instruction}{instruction}", "{instruction} {state} {state}",
                           "{instruction} {task}", "{instruction} }", "{{instruction}"})
    CHECK(contains(refused_robot("/text/2/text", text), "processor.recipe.text[2].text"));
}

TEST_CASE("a state in words needs a place in the text, and the place needs the words") {
  CHECK(contains(refused_robot("/text/2/text", "Task: {instruction}"), "a template with {state}"));
  CHECK(contains(refused_robot("/state/3", {{"op", "drop"}}), "no {state}"));
  CHECK(contains(refused_robot("/state/3", {{"op", "pad"}, {"size", 32}}), "no {state}"));
}

TEST_CASE("a robot's conventions come before the normalization, and nothing after the network's form") {
  Json recipe = robot();
  std::swap(recipe["state"][1], recipe["state"][2]);
  CHECK(contains(refused(recipe), "processor.recipe.state[2].op: expected the robot's conventions before normalize"));
  for (const char* last : {"bins", "drop"}) {
    recipe = robot();
    if (std::string(last) == "drop") recipe["state"][3] = {{"op", "drop"}};
    recipe["state"].push_back({{"op", "drop"}});
    CHECK(contains(refused(recipe), "nothing after pad, bins or drop"));
  }
}

}  // namespace recipe_test
