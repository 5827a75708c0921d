// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/recipe.h"

#include "processor/support.h"

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
  CHECK(recipe->letterbox.width == 512);
  CHECK(recipe->letterbox.height == 384);
  CHECK(recipe->letterbox.fill == 0.5f);
  REQUIRE(recipe->image.size() == 1);
  CHECK(recipe->image[0].scale == 2.0f);
  CHECK(recipe->image[0].shift == -1.0f);
  REQUIRE(recipe->text.size() == 1);
  CHECK(recipe->text[0].suffix == "\n");
  CHECK(recipe->max_tokens == 48);
  const auto& normalize = std::get<NormalizeOp>(recipe->state.at(0));
  CHECK(normalize.kind == NormKind::mean_std);
  CHECK(normalize.stats == "stats.observation.state");
  CHECK(normalize.eps == 1e-8f);
  CHECK(normalize.feature.empty());
  CHECK(std::get<PadOp>(recipe->state.at(1)).size == 32);
  CHECK(std::get<TakeOp>(recipe->action.at(0)).size == 7);
  CHECK(std::get<NormalizeOp>(recipe->action.at(1)).kind == NormKind::min_max);
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
  CHECK(contains(refused_at("/image/0/antialias", true), "processor.recipe.image[0].antialias"));
  CHECK(contains(refused_at("/image/0/align", "center"), "processor.recipe.image[0].align"));
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
  CHECK(contains(refused(recipe), "processor.recipe.image[0].op: expected a letterbox first"));
  recipe = sample();
  recipe["image"][1] = recipe["image"][0];
  CHECK(contains(refused(recipe), "processor.recipe.image[1].op"));
  recipe = sample();
  std::swap(recipe["text"][0], recipe["text"][1]);
  CHECK(contains(refused(recipe), "processor.recipe.text[1].op: expected nothing after tokenize"));
  recipe = sample();
  std::swap(recipe["state"][0], recipe["state"][1]);
  CHECK(contains(refused(recipe), "processor.recipe.state[1].op: expected nothing after pad"));
  CHECK(contains(refused_at("/image", Json::array()), "processor.recipe.image: expected a letterbox"));
  CHECK(contains(refused_at("/text", Json::array()), "processor.recipe.text: expected tokenize"));
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
  CHECK(std::get<NormalizeOp>(parsed->state.at(0)).kind == NormKind::identity);
}
