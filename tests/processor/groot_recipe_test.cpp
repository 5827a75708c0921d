// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Ops of a policy whose images keep their aspect and whose instruction is cleaned: GR00T N1.7.
#include <algorithm>
#include <cmath>

#include "processor/ops/normalize.h"
#include "processor/ops/pipeline.h"
#include "processor/python_text.h"
#include "processor/resample.h"
#include "processor/sample.h"

namespace groot_recipe_test {

using namespace vla;
using namespace vla::test;
using Json = nlohmann::json;

namespace {

constexpr const char* kRecipe = R"({
  "image":  [{"op": "square_pad"}, {"op": "smallest_side", "size": 4, "filter": "opencv_area"},
             {"op": "crop_fraction", "fraction": 0.5}, {"op": "size", "width": 2, "height": 2},
             {"op": "standardize", "mean": [0.5, 0.5, 0.5], "std": [0.5, 0.5, 0.5], "arithmetic": "float32_in_bytes"}],
  "text":   [{"op": "lower"}, {"op": "drop_punctuation"},
             {"op": "views", "count": 3, "open": "<img>", "token": "<IMG_CONTEXT>", "repeat": 5, "close": "</img>"},
             {"op": "template", "text": "user {instruction}\n"}, {"op": "tokenize", "max_tokens": 64, "truncate": "right"}],
  "state":  [{"op": "normalize", "kind": "groot_min_max", "stats": "stats.observation.state", "eps": 0.0},
             {"op": "clip", "low": -1.0, "high": 1.0}, {"op": "pad", "size": 4}],
  "action": [{"op": "rows", "count": 2}, {"op": "take", "size": 2}, {"op": "clip", "low": -1.0, "high": 1.0},
             {"op": "unnormalize", "kind": "groot_min_max", "stats": "stats.action", "eps": 0.0}]})";

EditableBundle groot() {
  EditableBundle bundle = sample();
  const Keys qwen = tokenizer_keys("qwen");
  for (const auto& [key, value] : qwen.all()) bundle.set(key, value);
  bundle.set("processor.recipe", std::string(kRecipe));
  bundle.set("observation.max_text_tokens", std::int64_t{64});
  bundle.set("policy.horizon", std::int64_t{3});
  bundle.set("policy.view_starts", std::vector<std::int64_t>{5, 12, 19});
  for (const char* name : {"stats.observation.state", "stats.action"}) {
    bundle.erase(std::string(name) + ".mean");
    bundle.erase(std::string(name) + ".std");
    add_stats(bundle, std::string(name) + ".min", {-1.0f, 0.0f});
    add_stats(bundle, std::string(name) + ".max", {3.0f, 0.0f});
  }
  return bundle;
}

Json with(const char* pointer, const Json& value) {
  Json recipe = Json::parse(kRecipe);
  recipe[Json::json_pointer(pointer)] = value;
  return recipe;
}

std::string refused(const Json& recipe) { return refusal(parse_recipe(recipe.dump()), Code::bad_bundle); }

}  // namespace

TEST_CASE("a mean over parts of pixels has the bytes of OpenCV") {
  const std::vector<std::uint8_t> row = {0, 0, 0, 90, 10, 1, 255, 0, 2};
  CHECK(resample_opencv_area(row, 3, 1, 2, 1) == std::vector<std::uint8_t>{30, 3, 0, 200, 3, 2});
  CHECK(resample_opencv_area(row, 3, 1, 1, 1) == std::vector<std::uint8_t>{115, 3, 1});
}

TEST_CASE("ops on images of any size cost half of the pixels that they read") {
  const Pipeline pipeline{4, 4, {SquarePad{}, SmallestSide{8}, CropFraction{0.5}}};
  CHECK(pipeline_work(pipeline, 20, 10) == (20 * 10 + 20 * 20 + 8 * 8) / 2);
  CHECK(pipeline_work({4, 4, {SmallestSide{4096}, SmallestSide{4096}}}, 1, 16384) > std::int64_t{1} << 35);
  CHECK(make(groot()).recipe().fit->work(20, 10) == (20 * 10 + 20 * 20 + 4 * 4) / 2);
}

TEST_CASE("text is lower-cased and cleaned as Python does it") {
  CHECK(python::lower("\u0130\u039f\u0394\u039f\u03a3 \u03a3 \u03a3A") ==
        "i\u0307\u03bf\u03b4\u03bf\u03c2 \u03c3 \u03c3a");
  CHECK(python::drop_punctuation("don't_stop -- n\u00b0 3\u00bd\u3002\u5f00\n") == "dont_stop  n 3\u00bd\u5f00\n");
}

TEST_CASE("a text is printed as a list of Python prints it") {
  CHECK(python::list_of("pick up the cup") == "['pick up the cup']");
  CHECK(python::list_of("") == "['']");
  CHECK(python::list_of("the robot's cup") == "[\"the robot's cup\"]");
  CHECK(python::list_of("the robot's \"cup\"") == "['the robot\\'s \"cup\"']");
  CHECK(python::list_of("a \"cup\"\\ {x}") == "['a \"cup\"\\\\ {x}']");
  CHECK(python::list_of("\t\n\r\v\x7f\u00a0\u00ad") == R"(['\t\n\r\x0b\x7f\xa0\xad'])");
  CHECK(python::list_of("n\u00b0 \u5f00 \U0001f642\u200b\u2028\U000e0001") ==
        "['n\u00b0 \u5f00 \U0001f642\\u200b\\u2028\\U000e0001']");
}

TEST_CASE("texts that a recipe quotes again and again are refused before they are large") {
  Json recipe = Json::parse(kRecipe);
  for (int i = 0; i < 10; ++i) recipe["text"].insert(recipe["text"].begin(), Json{{"op", "python_list"}});
  EditableBundle bundle = groot();
  bundle.set("processor.recipe", recipe.dump());
  Observation words = observation();
  words.states["state"] = {0.0f, 5.0f};
  for (const char* view : {"top", "wrist", "side"}) words.views[view] = Frame{4, 4, std::vector<std::uint8_t>(48, 255)};
  words.text = std::string(2000, '\\');
  CHECK(refusal(make(bundle).encode(words), Code::bad_observation).find("makes a prompt of at most") !=
        std::string::npos);
}

TEST_CASE("the kinds of GR00T have no epsilon and leave what has no spread") {
  using Direction = Normalizer::Direction;
  const auto map = [](const char* kind, Direction direction, double low, double high, float x) {
    return Normalizer(norm_rule(kind), direction, 0.0, {low}, {high}).map(x, 0);
  };
  for (const char* kind : {"groot_min_max", "groot_n1_5_min_max", "groot_n1_5_quantiles"}) {
    CHECK(map(kind, Direction::normalize, 0.0, 8.0, 2.0f) == -0.5);
    CHECK(map(kind, Direction::unnormalize, 0.0, 8.0, -0.5f) == 2.0);
    CHECK(map(kind, Direction::unnormalize, 1.0, 1.0, 5.0f) == 1.0);
  }
  CHECK(map("groot_min_max", Direction::normalize, 1.0, 1.0, 5.0f) == 0.0);
  CHECK(map("groot_n1_5_min_max", Direction::normalize, 1.0, 1.0, 5.0f) == 0.0);
  CHECK(map("groot_n1_5_quantiles", Direction::normalize, 1.0, 1.0, 5.0f) == 5.0);
  CHECK(map("groot_mean_std", Direction::normalize, 1.0, 2.0, 2.0f) == 0.5);
  CHECK(map("groot_mean_std", Direction::normalize, 7.0, 0.0, 3.0f) == 3.0);
  CHECK(map("groot_mean_std", Direction::unnormalize, 7.0, 0.0, 3.0f) == 3.0);
  CHECK(map("groot_n1_5_mean_std", Direction::normalize, 7.0, 0.0, 3.0f) == 3.0);
  CHECK(map("groot_n1_5_mean_std", Direction::unnormalize, 7.0, 0.0, 3.0f) == 7.0);
}

TEST_CASE("a range of N1.6 and N1.7 is applied in float64, and what has no statistic in it in float32") {
  const Normalizer up(norm_rule("groot_min_max"), Normalizer::Direction::normalize, 0.0, {0.1}, {0.7});
  CHECK(up.map(0.4f, 0) == 2 * static_cast<float>((0.4f - 0.1) / (0.7 - 0.1)) - 1);
  const Normalizer down(norm_rule("groot_min_max"), Normalizer::Direction::unnormalize, 0.0, {0.1}, {0.7});
  CHECK(down.map(0.3f, 0) == static_cast<double>((0.3f + 1) / 2) * (0.7 - 0.1) + 0.1);
}

TEST_CASE("keys of a state and of an action are normalized each in its own way") {
  EditableBundle bundle = groot();
  Json recipe = Json::parse(kRecipe);
  const Json range = {
      {"op", "normalize"}, {"kind", "groot_min_max"}, {"stats", "stats.observation.state"}, {"eps", 0.0}};
  Json first = range, second = range, action = range;
  first["columns"] = {0};
  second["kind"] = "groot_mean_std", second["columns"] = {1};
  recipe["state"] = {
      first, second, {{"op", "clip"}, {"low", -1.0}, {"high", 1.0}, {"columns", {0}}}, recipe["state"][2]};
  recipe["action"][2]["columns"] = {0};
  recipe["action"][3]["columns"] = {0};
  bundle.set("processor.recipe", recipe.dump());
  add_stats(bundle, "stats.observation.state.mean", {0.0f, 1.0f});
  add_stats(bundle, "stats.observation.state.std", {0.0f, 0.5f});
  const Processor processor = make(bundle);
  Observation observation;
  observation.states["state"] = {9.0f, 3.0f};
  Inputs inputs;
  REQUIRE(processor.encode_state(observation, inputs).ok());
  CHECK(inputs.state == std::vector<float>{1, 4, 0, 0});
  CHECK(*processor.decode(std::vector<float>{3, 3, 0, 0, -1, 7, 0, 0, 0, 0, 0, 0}, 3, 4, inputs.raw_state) ==
        std::vector<float>{3, 3, -1, 7});
  recipe["state"][1]["columns"] = {2};
  bundle.set("processor.recipe", recipe.dump());
  CHECK(contains(refusal(create(bundle), Code::bad_bundle),
                 "processor.recipe.state[1].columns: expected columns below 2"));
}

TEST_CASE("actions may have ranges of their own for each row of a chunk") {
  EditableBundle bundle = groot();
  for (const char* name : {"stats.action.min", "stats.action.max"}) bundle.erase(name);
  add_stats(bundle, "stats.action.min", {0, 0, 0, 0});
  add_stats(bundle, "stats.action.max", {2, 4, 20, 40});
  const std::vector<float> chunk = {0, 1, 9, 9, 0, 1, 9, 9, 0, 1, 9, 9};
  CHECK(*make(bundle).decode(chunk, 3, 4, std::vector<float>{0, 0}) == std::vector<float>{1, 4, 10, 40});
  bundle.erase("stats.action.max");
  add_stats(bundle, "stats.action.max", {2, 4, 20, 40, 60, 80});
  CHECK(contains(refusal(create(bundle), Code::bad_bundle), "stats.action.max: expected 2 numbers, or 2 rows of them"));
  bundle.erase("stats.action.max");
  add_stats(bundle, "stats.action.max", {2, 4});
  CHECK(contains(refusal(create(bundle), Code::bad_bundle), "stats.action.max: expected 4 numbers"));
}

TEST_CASE("an action is added to the columns of the state that the recipe names") {
  EditableBundle bundle = groot();
  Json recipe = Json::parse(kRecipe);
  recipe["action"].push_back({{"op", "add_state"}, {"columns", {1}}, {"state_columns", {0}}});
  bundle.set("processor.recipe", recipe.dump());
  const Processor processor = make(bundle);
  CHECK(processor.relative_actions());
  CHECK(*processor.decode(std::vector<float>(12, 1.0f), 3, 4, std::vector<float>{5, 7}) ==
        std::vector<float>{3, 5, 3, 5});
  recipe["action"].back()["state_columns"] = {2};
  bundle.set("processor.recipe", recipe.dump());
  CHECK(
      contains(refusal(create(bundle), Code::bad_bundle), "processor.recipe.action[4]: expected columns of the state"));
  CHECK(contains(refused(with("/action/3", {{"op", "add_state"}, {"columns", {1}}, {"state_columns", {0, 1}}})),
                 "processor.recipe.action[3].state_columns: expected as many as columns"));
}

TEST_CASE("angles become sines and cosines, feature by feature") {
  EditableBundle bundle = groot();
  bundle.set("observation.states", std::vector<std::string>{"state.grip", "state.arm"});
  bundle.set("observation.state_dims", std::vector<std::int64_t>{1, 2});
  bundle.set("observation.state_names", std::vector<std::string>{"g", "a", "b"});
  bundle.set("observation.state_units", std::vector<std::string>{"", "", ""});
  Json recipe = Json::parse(kRecipe);
  recipe["state"] = {{{"op", "threshold"}, {"columns", {0}}, {"above", 0.5}, {"then", 1.0}, {"else", 0.0}},
                     {{"op", "sin_cos"}, {"columns", {1, 2}}},
                     {{"op", "pad"}, {"size", 6}}};
  bundle.set("processor.recipe", recipe.dump());
  bundle.set("policy.d_state", std::int64_t{6});
  Observation observation;
  observation.states = {{"grip", {0.75f}}, {"arm", {0.5f, -2.0f}}};
  Inputs inputs;
  REQUIRE(make(bundle).encode_state(observation, inputs).ok());
  const auto sine = [](double x) { return static_cast<float>(std::sin(x)); };
  const auto cosine = [](double x) { return static_cast<float>(std::cos(x)); };
  CHECK(inputs.state == std::vector<float>{1, sine(0.5), sine(-2), cosine(0.5), cosine(-2), 0});
  CHECK(inputs.raw_state == std::vector<float>{1, 0.5f, -2});
  recipe["state"][2]["size"] = 4;
  bundle.set("processor.recipe", recipe.dump());
  CHECK(contains(refusal(create(bundle), Code::bad_bundle), "processor.recipe.state[2].size: expected at least the 5"));
  recipe["state"][1]["columns"] = {2};
  bundle.set("processor.recipe", recipe.dump());
  CHECK(contains(
      refusal(create(bundle), Code::bad_bundle),
      "processor.recipe.state[1].columns: expected all 2 columns of a feature from column 1, found 1 of them"));
}

TEST_CASE("a state of several moments is padded row by row") {
  EditableBundle bundle = groot();
  Json recipe = Json::parse(kRecipe);
  recipe["state"] = {{{"op", "pad"}, {"size", 6}, {"rows", 2}}};
  bundle.set("processor.recipe", recipe.dump());
  bundle.set("policy.d_state", std::int64_t{6});
  Observation observation;
  observation.states = {{"state", {3, 4}}};
  Inputs inputs;
  REQUIRE(make(bundle).encode_state(observation, inputs).ok());
  CHECK(inputs.state == std::vector<float>{3, 0, 0, 4, 0, 0});
  recipe["state"][0]["rows"] = 4;
  bundle.set("processor.recipe", recipe.dump());
  CHECK(contains(refusal(create(bundle), Code::bad_bundle),
                 "processor.recipe.state[0].rows: expected a divisor of 2 and 6"));
}

TEST_CASE("ops on images end in size, and rows come first") {
  CHECK(parse_recipe(kRecipe).ok());
  Json recipe = Json::parse(kRecipe);
  recipe["image"].erase(3);
  CHECK(contains(refused(recipe), "processor.recipe.image[3].op"));
  recipe = Json::parse(kRecipe);
  std::swap(recipe["action"][0], recipe["action"][1]);
  CHECK(contains(refused(recipe), "processor.recipe.action[1].op: expected rows as the first op"));
  CHECK(contains(refused(with("/image/1/filter", "lanczos")), "processor.recipe.image[1].filter"));
  CHECK(contains(refused(with("/image/2/fraction", 1.5)), "processor.recipe.image[2].fraction"));
  CHECK(contains(refused(with("/state/0/eps", 1e-8)), "processor.recipe.state[0].eps"));
  CHECK(contains(refused(with("/text/3/op", "lower")), "processor.recipe.text[3].op"));
}

TEST_CASE("a pipeline keeps the aspect, refuses another and takes bytes only") {
  std::vector<float> out(12);
  const Frame wide{4, 2, std::vector<std::uint8_t>(24, 255)};
  CHECK(run_pipeline(wide, 0, {2, 2, {SquarePad{}, SmallestSide{2}}}, out, "top").ok());
  CHECK(out == std::vector<float>(12, 128.0f / 255.0f));
  const std::string message =
      refusal(run_pipeline(wide, 0, {2, 2, {SmallestSide{2}}}, out, "top"), Code::bad_observation);
  CHECK(contains(message, "top: expected an image with the aspect of 2 x 2, found 4 x 2, which becomes 4 x 2"));
  const Frame sliver{1, 60000, std::vector<std::uint8_t>(180000)};
  CHECK(contains(
      refusal(run_pipeline(sliver, 0, {2, 2, {SquarePad{}, SmallestSide{2}}}, out, "top"), Code::bad_observation),
      "top"));
  const Frame floats{2, 2, std::vector<float>(12)};
  CHECK(contains(refusal(run_pipeline(floats, 0, {2, 2, {}}, out, "top"), Code::bad_observation), "8 bits"));
}

TEST_CASE("a chunk has the rows that the recipe keeps, and a clip hides nothing") {
  const Processor processor = make(groot());
  CHECK(processor.n_row(3) == 2);
  const std::vector<float> raw = {0.0f, 0.0f};
  std::vector<float> chunk = {0, 0, 9, 9, 5, 5, 9, 9, NAN, NAN, 9, 9};
  CHECK(*processor.decode(chunk, 3, 4, raw) == std::vector<float>{1, 0, 3, 0});
  chunk[4] = INFINITY;
  CHECK(contains(refusal(processor.decode(chunk, 3, 4, raw), Code::bad_action), "actions[1][\"shoulder\"]"));
  EditableBundle bundle = groot();
  bundle.set("policy.horizon", std::int64_t{1});
  CHECK(contains(refusal(create(bundle), Code::bad_bundle), "processor.recipe.action[0].count"));
  Json recipe = Json::parse(kRecipe);
  recipe["action"][0] = {{"op", "rows"}, {"first", 1}, {"count", 1}};
  EditableBundle later = groot();
  later.set("processor.recipe", recipe.dump());
  const Processor last = make(later);
  CHECK(last.first_row() == 1);
  CHECK(*last.decode(std::vector<float>{NAN, NAN, 9, 9, 5, 5, 9, 9, NAN, NAN, 9, 9}, 3, 4, raw) ==
        std::vector<float>{3, 0});
  recipe["action"][0]["first"] = 3;
  later.set("processor.recipe", recipe.dump());
  CHECK(contains(refusal(create(later), Code::bad_bundle), "1 from row 3 on"));
}

TEST_CASE("without views the recipe has no ops on images, and with views it has some") {
  Json recipe = Json::parse(kRecipe);
  recipe["image"] = Json::array();
  EditableBundle bundle = groot();
  bundle.set("processor.recipe", recipe.dump());
  CHECK(contains(refusal(create(bundle), Code::bad_bundle),
                 "processor.recipe.image: expected ops of the views, found none"));
}

TEST_CASE("an empty instruction becomes what the recipe says, and one of punctuation alone is still refused") {
  Json recipe = Json::parse(kRecipe);
  recipe["text"].insert(recipe["text"].begin(), Json{{"op", "if_empty"}, {"text", "Pick up."}});
  EditableBundle bundle = groot();
  bundle.set("processor.recipe", recipe.dump());
  const Processor plain = make(groot()), filled = make(bundle);
  Observation empty = observation(), words = observation();
  empty.states["state"] = words.states["state"] = {0.0f, 5.0f};
  for (const char* view : {"top", "wrist", "side"})
    empty.views[view] = words.views[view] = Frame{4, 4, std::vector<std::uint8_t>(48, 255)};
  empty.text = "", words.text = "pick up";
  const auto inputs = filled.encode(empty);
  REQUIRE_MESSAGE(inputs.ok(), inputs.error().message());
  CHECK(inputs->tokens == plain.encode(words)->tokens);
  CHECK(std::count(inputs->notes.begin(), inputs->notes.end(), "instruction: empty") == 1);
  CHECK(filled.encode(words)->tokens == inputs->tokens);
  CHECK(plain.encode(empty)->tokens != inputs->tokens);
  words.text = "?!";
  for (const Processor* processor : {&plain, &filled})
    CHECK(contains(refusal(processor->encode(words), Code::bad_observation), "nothing but punctuation"));
  recipe["text"][0]["text"] = "";
  bundle.set("processor.recipe", recipe.dump());
  CHECK(contains(refusal(create(bundle), Code::bad_bundle),
                 "processor.recipe.text[0].text: expected a text that is not empty"));
}

TEST_CASE("a template stands around the places for views, and words must be left of an instruction") {
  const Processor processor = make(groot());
  Observation seen = observation();
  seen.states["state"] = {0.0f, 5.0f};
  seen.views["top"] = seen.views["wrist"] = seen.views["side"] = Frame{4, 4, std::vector<std::uint8_t>(48, 255)};
  seen.text = "PICK, up!";
  const auto inputs = processor.encode(seen);
  REQUIRE_MESSAGE(inputs.ok(), inputs.error().message());
  CHECK(inputs->pixels == std::vector<float>(36, 1.0f));
  CHECK(inputs->state == std::vector<float>{-0.5f, 0.0f, 0.0f, 0.0f});
  const std::vector<std::int32_t> tokens = inputs->tokens;
  seen.text = "pick up";
  CHECK(processor.encode(seen)->tokens == tokens);
  seen.text = "?!";
  CHECK(contains(refusal(processor.encode(seen), Code::bad_observation), "nothing but punctuation"));
}

namespace {

/// 6 x 4 pixels.
std::vector<std::uint8_t> colours() {
  std::vector<std::uint8_t> rgb;
  for (int y = 0; y < 4; ++y)
    for (int x = 0; x < 6; ++x)
      for (int c = 0; c < 3; ++c) rgb.push_back(static_cast<std::uint8_t>(x * 38 + y * 91 + c * 53));
  return rgb;
}

}  // namespace

TEST_CASE("bicubic resizes of bytes are those of Pillow and of torchvision, whose weights have 16 bits") {
  std::vector<std::uint8_t> expected = {17,  70, 127, 91,  150, 186, 170, 230, 35,  81,  153, 190, 178, 125, 86,
                                        152, 87, 81,  163, 157, 124, 120, 79,  79,  109, 87,  167, 148, 107, 69,
                                        50,  92, 152, 115, 148, 167, 32,  90,  151, 115, 179, 201, 190, 119, 49};
  CHECK(resample_pillow_bicubic(colours(), 6, 4, 3, 5) == expected);
  expected[1] = 69;
  CHECK(resample_torch_16bit(colours(), 6, 4, 3, 5) == expected);
}

TEST_CASE("a sliver of an image is refused before it is padded or scaled") {
  Json recipe = Json::parse(kRecipe);
  const auto apply = [&](int width, int height) {
    const auto parsed = parse_recipe(recipe.dump());
    REQUIRE(parsed.ok());
    std::vector<float> out(12);
    const Frame frame{width, height, std::vector<std::uint8_t>(static_cast<std::size_t>(width) * height * 3)};
    return parsed->fit->apply(frame, 0, out, "view");
  };
  CHECK(contains(refusal(apply(1, 8000), Code::bad_observation),
                 "view: expected an image that padding and scaling make no larger than 1048576 pixels, found 1 x 8000, "
                 "which becomes 8000 x 8000"));
  refusal(apply(2048, 511), Code::bad_observation);
  CHECK(apply(2048, 512).ok());
  CHECK(apply(1, 1024).ok());
  recipe["image"].erase(0);
  recipe["image"][0]["size"] = 256;
  CHECK(contains(refusal(apply(1, 8000), Code::bad_observation), "which becomes 256 x 2048000"));
}

namespace {

/// The images of a policy that keeps their aspect, for cameras that lead to this width, and then resizes them.
Json resized_twice(int width) {
  const Json side = {{"op", "smallest_side"}, {"size", 16}, {"filter", "opencv_area"}};
  const Json expected = {{"op", "expect_size"}, {"width", width}, {"height", 16}};
  const Json resize = {{"op", "resize"}, {"width", 16}, {"height", 16}, {"filter", "pillow_bicubic"}};
  return with("/image", Json::array({side, expected, resize, {{"op", "size"}, {"width", 16}, {"height", 16}}}));
}

std::string refusal_of(const Recipe& recipe, int width, int height) {
  std::vector<float> out(static_cast<std::size_t>(3) * recipe.width * recipe.height);
  const Frame frame{width, height, std::vector<std::uint8_t>(static_cast<std::size_t>(width) * height * 3)};
  const Status taken = recipe.fit->apply(frame, 0, out, "view");
  return taken ? "" : taken.error().message();
}

}  // namespace

TEST_CASE("a frame of another aspect is refused, also where images are resized twice") {
  const auto square = parse_recipe(resized_twice(16).dump()), wide = parse_recipe(resized_twice(21).dump());
  REQUIRE(square.ok());
  REQUIRE(wide.ok());
  CHECK(refusal_of(*square, 640, 640).empty());
  CHECK(refusal_of(*square, 9, 9).empty());
  CHECK(contains(refusal_of(*square, 640, 480),
                 "expected an image with the aspect of 16 x 16, found 640 x 480, which becomes 21 x 16"));
  CHECK(refusal_of(*wide, 640, 480).empty());
  CHECK(refusal_of(*wide, 320, 240).empty());
  CHECK(contains(refusal_of(*wide, 480, 640), "which becomes 16 x 21"));
  CHECK(contains(refusal_of(*wide, 1280, 720), "which becomes 28 x 16"));
}

TEST_CASE("every filter on bytes resizes frames and images alike, and planes are made of frames alone") {
  for (const char* filter : {"opencv_bilinear", "torch_bicubic_8bit", "pillow_bicubic", "torch_bicubic_16bit"}) {
    CAPTURE(filter);
    const Json resize = {{"op", "resize"}, {"width", 3}, {"height", 5}, {"filter", filter}};
    const Json size = {{"op", "size"}, {"width", 3}, {"height", 5}};
    const auto first = parse_recipe(with("/image", Json::array({resize})).dump());
    const Json kept = {{"op", "crop_fraction"}, {"fraction", 1}};
    const auto second = parse_recipe(with("/image", Json::array({kept, resize, size})).dump());
    REQUIRE_MESSAGE(first.ok(), first.error().message());
    REQUIRE_MESSAGE(second.ok(), second.error().message());
    std::vector<float> of_frame(45, -1.0f), of_image(45, -2.0f);
    CHECK(first->fit->apply({6, 4, colours()}, 0, of_frame, "view").ok());
    CHECK(second->fit->apply({6, 4, colours()}, 0, of_image, "view").ok());
    CHECK(of_frame == of_image);
  }
  const Json planes = {{"op", "resize"}, {"width", 3}, {"height", 5}, {"filter", "torch_bilinear"}};
  const auto late = parse_recipe(with("/image", Json::array({{{"op", "square_pad"}}, planes})).dump());
  CHECK(contains(refusal(late, Code::bad_bundle), "image[1].filter: expected a filter on bytes"));
}

TEST_CASE("a resize that would squeeze the frames of any camera is refused with the bundle") {
  Json recipe = resized_twice(16);
  recipe["image"].erase(1);
  CHECK(contains(refused(recipe), "processor.recipe.image[1].op: expected images of one aspect"));
  const Json pad = {{"op", "square_pad"}};
  recipe["image"].insert(recipe["image"].begin(), pad);
  CHECK(parse_recipe(recipe.dump()).ok());
  recipe["image"][0] = {{"op", "camera_size"}, {"width", 640}, {"height", 480}};
  CHECK(parse_recipe(recipe.dump()).ok());
}

TEST_CASE("a frame of another camera than the policy was trained with is refused, and a crop takes the middle") {
  const Json crop = {{"op", "center_crop"}, {"width", 3}, {"height", 1}};
  Json recipe = Json::parse(kRecipe);
  recipe["image"] = Json::array(
      {{{"op", "camera_size"}, {"width", 6}, {"height", 4}}, crop, {{"op", "size"}, {"width", 3}, {"height", 1}}});
  const auto parsed = parse_recipe(recipe.dump());
  REQUIRE(parsed.ok());
  std::vector<float> out(9);
  CHECK(parsed->fit->apply({6, 4, colours()}, 0, out, "view").ok());
  // 3 of 6 columns leave 1.5 on each side, 1 of 4 rows the same: both are rounded to 2, the even number.
  CHECK(out[0] == doctest::Approx((2 * 38 + 2 * 91) % 256 / 255.0));
  CHECK_FALSE(parsed->fit->apply({4, 6, colours()}, 0, out, "view").ok());
  recipe["image"][1]["width"] = 7;
  recipe["image"][2]["width"] = 7;
  const auto wide = parse_recipe(recipe.dump());
  REQUIRE(wide.ok());
  std::vector<float> row(21);
  CHECK_FALSE(wide->fit->apply({6, 4, colours()}, 0, row, "view").ok());
}

TEST_CASE("views behind the instruction are found from the end of the prompt, whatever its length") {
  EditableBundle bundle = groot();
  Json recipe = with("/text/2/place", "back");
  recipe["text"][2]["open"] = "view {i}<img>";
  bundle.set("processor.recipe", recipe.dump());
  bundle.remove_key("policy.view_starts");
  const std::string refusal_of_none = refusal(create(bundle), Code::bad_bundle);
  CHECK(contains(refusal_of_none, "policy.view_starts_from_end"));
  // The line's end, then from the back 5 tokens and the mark behind them, and the number and mark in front.
  bundle.set("policy.view_starts_from_end", std::vector<std::int64_t>{1, 2, 3});
  const std::string told = refusal(create(bundle), Code::bad_bundle);
  const auto at = told.find("expected ") + 9;
  std::vector<std::int64_t> starts;
  for (std::size_t i = at; starts.size() < 3; i = told.find(", ", i) + 2) starts.push_back(std::stoi(told.substr(i)));
  CHECK(starts[2] > 6);
  bundle.set("policy.view_starts_from_end", starts);
  const Processor processor = make(bundle);
  Observation seen = observation();
  seen.views["top"] = seen.views["wrist"] = seen.views["side"] = Frame{4, 4, std::vector<std::uint8_t>(48, 255)};
  for (const char* text : {"pick", "pick up the cube and put it down"}) {
    seen.text = text;
    const auto inputs = processor.encode(seen);
    REQUIRE_MESSAGE(inputs.ok(), inputs.error().message());
    const std::vector<std::int32_t>& tokens = inputs->tokens;
    for (const std::int64_t start : starts) {
      const auto first = tokens.end() - start;
      CHECK(std::count(first, first + 5, *first) == 5);
      CHECK(*(first - 1) != *first);
    }
  }
  seen.text = std::string(200, 'x');
  CHECK(contains(refusal(processor.encode(seen), Code::bad_observation), "shorten the instruction"));
}

TEST_CASE("frames of several cameras lie in the corner of a canvas") {
  Json recipe = Json::parse(kRecipe);
  recipe["image"] = {{{"op", "camera_size"}, {"view", 0}, {"width", 2}, {"height", 1}},
                     {{"op", "camera_size"}, {"view", 1}, {"width", 1}, {"height", 2}},
                     {{"op", "canvas"}, {"width", 2}, {"height", 2}},
                     {{"op", "size"}, {"width", 2}, {"height", 2}}};
  const auto parsed = parse_recipe(recipe.dump());
  REQUIRE(parsed.ok());
  const Fit& fit = *parsed->fit;
  CHECK(fit.n_view() == 2);
  CHECK((fit.camera_size(0)->width == 2 && fit.camera_size(1)->width == 1 && !fit.camera_size(2)));
  const Frame wide{2, 1, std::vector<std::uint8_t>{51, 102, 153, 204, 255, 0}};
  std::vector<float> out(12);
  REQUIRE(fit.apply(wide, 0, out, "view").ok());
  CHECK(out == std::vector<float>{0.2f, 0.8f, 0, 0, 0.4f, 1.0f, 0, 0, 0.6f, 0, 0, 0});
  const Frame tall{1, 2, std::vector<float>{0.1f, 0.2f, 0.3f, 0.4f, 0.5f, 0.6f}};
  REQUIRE(fit.apply(tall, 1, out, "view").ok());
  CHECK(out == std::vector<float>{0.1f, 0, 0.4f, 0, 0.2f, 0, 0.5f, 0, 0.3f, 0, 0.6f, 0});
  CHECK(contains(refusal(fit.apply(tall, 0, out, "view"), Code::bad_observation), "expected an image of 2 x 1"));
  recipe["image"][2]["height"] = 1;
  recipe["image"][3]["height"] = 1;
  const auto low = parse_recipe(recipe.dump());
  REQUIRE(low.ok());
  CHECK_FALSE(low->fit->apply(tall, 1, std::span(out).first(6), "view").ok());
}

TEST_CASE("floats come as they are where no op changes a pixel, and are refused where one does") {
  Json recipe = Json::parse(kRecipe);
  recipe["image"] = {{{"op", "camera_size"}, {"width", 2}, {"height", 1}},
                     {{"op", "size"}, {"width", 2}, {"height", 1}}};
  const auto taken = parse_recipe(recipe.dump());
  REQUIRE(taken.ok());
  const Frame frame{2, 1, std::vector<float>{0.1f, 0.2f, 0.3f, 0.4f, 0.5f, 0.6f}};
  std::vector<float> out(6);
  REQUIRE(taken->fit->apply(frame, 0, out, "view").ok());
  CHECK(out == std::vector<float>{0.1f, 0.4f, 0.2f, 0.5f, 0.3f, 0.6f});
  const Frame other{1, 2, std::vector<float>(6)};
  CHECK(contains(taken->fit->apply(other, 0, out, "view").error().message(), "expected an image of 2 x 1"));
  const Json pad = {{"op", "square_pad"}};
  recipe["image"].insert(recipe["image"].begin() + 1, pad);
  recipe["image"][2]["height"] = 2;
  const auto padded = parse_recipe(recipe.dump());
  REQUIRE(padded.ok());
  std::vector<float> square(12);
  CHECK(contains(padded->fit->apply(frame, 0, square, "view").error().message(), "expected pixels of 8 bits"));
}

}  // namespace groot_recipe_test
