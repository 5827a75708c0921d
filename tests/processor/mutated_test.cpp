// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Odd images and recipes through the checks of the fuzz targets, driven by a mutator that every compiler has.
#include <filesystem>

#include "fuzz/image_target.h"
#include "fuzz/mutate.h"
#include "fuzz/recipe_target.h"
#include "processor/sample.h"

namespace mutated_test {

using namespace vla;
using namespace vla::test;
using fuzz::Random;
using Json = nlohmann::json;

namespace {

/// Lists of ops beside those of the sample, so that every kind of them is met.
constexpr const char* kLists[][2] = {
    {"image", R"([{"op": "smallest_side", "size": 6, "filter": "opencv_area"}, {"op": "crop_fraction", "fraction": 0.9},
                  {"op": "square_pad"}, {"op": "size", "width": 7, "height": 7}, {"op": "clip", "low": 0, "high": 1}])"},
    {"image", R"([{"op": "resize", "width": 6, "height": 4, "filter": "torch_bicubic_8bit"},
                  {"op": "standardize", "mean": [0.5, 0.4, 0.3], "std": [0.2, 0.2, 0.2], "arithmetic": "bfloat16"}])"},
    {"image", R"([{"op": "resize", "width": 5, "height": 9, "filter": "opencv_bilinear"}])"},
    {"image", R"([{"op": "resize", "width": 7, "height": 3, "filter": "torch_bilinear"}])"},
    {"image", R"([{"op": "resize_floats", "width": 3, "height": 5, "filter": "area"},
                  {"op": "resize_floats", "width": 6, "height": 4, "filter": "bicubic"}])"},
    {"text",
     R"([{"op": "refuse", "text": "<|"}, {"op": "strip"}, {"op": "lower"}, {"op": "replace", "from": "p", "to": "q r"}, {"op": "drop_punctuation"},
                 {"op": "python_list"}, {"op": "template", "text": "Do: {instruction}!"}, {"op": "tokenize", "max_tokens": 8, "truncate": "left"}])"},
    {"text",
     R"([{"op": "template", "text": "{instruction} {state}"}, {"op": "tokenize", "max_tokens": 8, "truncate": "left"}])"},
    {"state",
     R"([{"op": "affine", "columns": [0], "scale": 2, "shift": 1}, {"op": "horn_angle", "columns": [1], "scale": 1,
                  "shift": 0, "arm_length": 0.036, "horn_radius": 0.022}, {"op": "pad", "size": 4, "value": -1}])"},
    {"state", R"([{"op": "normalize", "kind": "mean_std", "stats": "stats.observation.state", "eps": 0.5},
                  {"op": "clip", "low": -1, "high": 1}, {"op": "bins", "low": -1, "high": 1, "count": 256}])"},
    {"action", R"([{"op": "rows", "count": 4}, {"op": "take", "size": 2}, {"op": "add_state", "columns": [0]},
                   {"op": "threshold", "columns": [1], "above": 0.5, "then": 1, "else": -1},
                   {"op": "affine", "columns": [0], "scale": 3, "shift": 1}, {"op": "clip", "low": -5, "high": 5}])"}};

}  // namespace

TEST_CASE("odd recipes are refused, or run in bounded time and memory") {
  Random random(1);
  EditableBundle bundle = sample();
  bundle.set("policy.horizon", std::int64_t{8});
  const Json sound = Json::parse(*bundle.keys.string("processor.recipe"));
  int n_run = 0;
  constexpr int kRounds = 1500;
  for (int round = 0; round < kRounds; ++round) {
    Json recipe = sound;
    for (std::size_t n = fuzz::below(random, 3); n > 0; --n) {
      const auto& [list, ops] = kLists[fuzz::below(random, std::size(kLists))];
      recipe[list] = Json::parse(ops);
    }
    bundle.set("processor.recipe", fuzz::odd_json(recipe.dump(), random));
    const std::string bytes = bundle.bytes();
    const auto parsed = Bundle::parse(bytes_of(bytes), "odd.gguf");
    REQUIRE(parsed.ok());
    n_run += fuzz::check_recipe(*parsed, observation()) ? 1 : 0;
  }
  CHECK(n_run > kRounds / 50);
  CHECK(n_run < kRounds);
}

TEST_CASE("damaged images are refused, or decode in bounded time and memory") {
  Random random(1);
  int n_file = 0;
  for (const auto& entry : std::filesystem::directory_iterator(data_path("images"))) {
    const std::string sound = read_text(entry.path());
    for (int round = 0; round < 20; ++round) {
      const std::string bytes = fuzz::damaged(sound, random);
      fuzz::check_image(bytes_of(bytes));
    }
    ++n_file;
  }
  CHECK(n_file > 60);
}

}  // namespace mutated_test
