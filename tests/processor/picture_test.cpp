// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/picture.h"

#include "processor/sample.h"

namespace picture_test {

using namespace vla;
using namespace vla::test;
using Json = nlohmann::json;

namespace {

const std::vector<std::uint8_t>& bytes_in(const Frame& frame) { return std::get<std::vector<std::uint8_t>>(frame.rgb); }

}  // namespace

TEST_CASE("a picture is what the network gets: fitted by the recipe, its values in the scale of a frame again") {
  Frame frame = grey(51);
  const auto as_it_came = picture_of(make(), frame, 0);  // of the network's size, so that nothing is resized
  REQUIRE_MESSAGE(as_it_came.ok(), as_it_came.error().message());
  CHECK(as_it_came->rgb == frame.rgb);

  frame.width = frame.height = 2;
  std::get<std::vector<std::uint8_t>>(frame.rgb).resize(12);
  const auto fitted = picture_of(make(), frame, 0);
  REQUIRE(fitted.ok());
  CHECK((fitted->width == 4 && fitted->height == 2));
  CHECK(bytes_in(*fitted)[0] == 0);  // black before the frame, which stands at the right
  CHECK(bytes_in(*fitted)[6] == 51);
}

TEST_CASE("a picture takes the ops of its own view alone, and black for what is no number") {
  EditableBundle bundle = sample();
  Json recipe = Json::parse(*bundle.keys.string("processor.recipe"));
  recipe["image"][1] = Json::parse(R"({"op": "standardize", "mean": [0.5, 0.4, 0.3], "std": [0.25, 0.5, 0.1],
                                       "arithmetic": "float32", "view": 1})");
  recipe["image"].push_back(Json::parse(R"({"op": "clip", "low": 0.0, "high": 1.0})"));
  bundle.set("processor.recipe", recipe.dump());
  const Processor processor = make(bundle);
  const auto first = [&](const Processor& by, std::uint8_t value, int view) {
    const auto picture = picture_of(by, grey(value), view);
    REQUIRE(picture.ok());
    return std::vector<int>(bytes_in(*picture).begin(), bytes_in(*picture).begin() + 3);
  };
  CHECK(first(processor, 120, 0) == std::vector<int>{120, 120, 120});  // the clip changes nothing there
  // (120 / 255 - mean) / std, below 0 for red, and of the others what is left between the ends 0 and 1.
  CHECK(first(processor, 120, 1) == std::vector<int>{0, 36, 255});
  recipe["image"][1] = Json::parse(R"({"op": "affine", "scale": 0.0, "shift": 0.5})");
  bundle.set("processor.recipe", recipe.dump());
  CHECK(first(make(bundle), 120, 0) == std::vector<int>{0, 0, 0});
}

TEST_CASE("no picture is made of a frame that an observation could not have") {
  Frame frame = grey(51);
  frame.width = 3;
  CHECK(contains(refusal(picture_of(make(), frame, 1), Code::bad_observation), "observation.images.wrist"));
}

}  // namespace picture_test
