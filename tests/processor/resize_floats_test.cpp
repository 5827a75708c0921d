// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/ops/resize_floats.h"

#include <algorithm>

#include "processor/images.h"
#include "processor/recipe.h"

namespace resize_floats_test {

using namespace vla;
using namespace vla::test;
using Json = nlohmann::json;

namespace {

const ResizeFilter* const kArea = find_resize_filter("resize_floats", "area");
const ResizeFilter* const kBicubic = find_resize_filter("resize_floats", "bicubic");

std::vector<float> resized(const Frame& frame, const FloatResizes& to) {
  std::vector<float> out(static_cast<std::size_t>(3 * to.sizes.back().width * to.sizes.back().height), NAN);
  const Status status = resize_floats(frame, to, out, "top");
  REQUIRE_MESSAGE(status.ok(), status.error().message());
  return out;
}

void check_plane(const std::vector<float>& planes, std::size_t channel, const std::vector<float>& expected) {
  REQUIRE(planes.size() == 3 * expected.size());
  for (std::size_t i = 0; i < expected.size(); ++i)
    CHECK(planes[channel * expected.size() + i] == doctest::Approx(expected[i]).epsilon(1e-6));
}

Json size_op(int width, int height, const char* filter) {
  return {{"op", "resize_floats"}, {"width", width}, {"height", height}, {"filter", filter}};
}

Result<Recipe> parsed(const Json& image) {
  const Json recipe = {{"image", image}, {"text", Json::array()}, {"state", Json::array()}, {"action", Json::array()}};
  return parse_recipe(recipe.dump());
}

}  // namespace

// The numbers are torch's: F.interpolate(mode="area") to 3 x 3, then torchvision's resize, bicubic with antialiasing.
TEST_CASE("areas that overlap are averaged, and a bicubic enlargement follows in floats") {
  const Frame frame = frame_of(5, 4);
  const std::vector<float> areas = {0.15392157f, 0.19803922f, 0.24215686f, 0.20686276f, 0.25686276f,
                                    0.30686277f, 0.25980392f, 0.31568626f, 0.37156862f};
  const std::vector<float> twice = {0.26101586f, 0.27223653f, 0.29598352f, 0.32140023f, 0.34514722f, 0.35636786f,
                                    0.29293227f, 0.30507013f, 0.33075836f, 0.35825279f, 0.38394108f, 0.39607894f,
                                    0.33942074f, 0.35289466f, 0.38141048f, 0.41193128f, 0.44044712f, 0.45392102f,
                                    0.37133712f, 0.38572833f, 0.41618538f, 0.44878396f, 0.47924101f, 0.49363217f};
  for (const Frame& given : {frame, as_floats(frame)}) {
    check_plane(resized(given, {{}, {{3, 3, kArea}}}), 1, areas);
    check_plane(resized(given, {{}, {{3, 3, kArea}, {6, 4, kBicubic}}}), 2, twice);
  }
}

TEST_CASE("a bicubic edge overshoots and is not clamped") {
  std::vector<float> rgb;
  for (int row = 0; row < 2; ++row)
    for (const float x : {0.0f, 0.0f, 1.0f, 1.0f}) rgb.insert(rgb.end(), 3, x);
  const std::vector<float> out = resized({4, 2, rgb}, {{}, {{8, 2, kBicubic}}});
  CHECK(out[2] == doctest::Approx(-0.06870229f).epsilon(1e-6));
  CHECK(out[5] == doctest::Approx(1.06870234f).epsilon(1e-6));
}

TEST_CASE("a frame that has the size passes as it is") {
  const Frame frame = frame_of(4, 3);
  const std::vector<float> out = resized(frame, {CameraSize{4, 3}, {{4, 3, kArea}, {4, 3, kBicubic}}});
  const auto& bytes = std::get<std::vector<std::uint8_t>>(frame.rgb);
  for (std::size_t i = 0; i < 12; ++i) CHECK(out[12 + i] == static_cast<float>(bytes[3 * i + 1]) / 255.0f);
}

TEST_CASE("a frame of another camera is refused, and the camera's size is told") {
  const Json from = {{"from_width", 6}, {"from_height", 4}};
  Json op = size_op(8, 8, "bicubic");
  op.update(from);
  const auto recipe = parsed(Json::array({op}));
  REQUIRE_MESSAGE(recipe.ok(), recipe.error().message());
  const auto camera = recipe->fit->camera_size(0);
  REQUIRE(camera);
  CHECK(camera->width == 6);
  CHECK(camera->height == 4);
  std::vector<float> planes(192);
  CHECK(recipe->fit->apply(frame_of(6, 4), 0, planes, "top").ok());
  const Status status = recipe->fit->apply(frame_of(4, 6), 0, planes, "top");
  REQUIRE_FALSE(status.ok());
  CHECK(contains(status.error().message(), "top: expected an image of 6 x 4, found 4 x 6"));
}

TEST_CASE("sizes follow each other, of the last one are the network's images") {
  const auto recipe = parsed(Json::array({size_op(5, 4, "area"), size_op(8, 6, "bicubic")}));
  REQUIRE_MESSAGE(recipe.ok(), recipe.error().message());
  CHECK(recipe->width == 8);
  CHECK(recipe->height == 6);
  CHECK_FALSE(recipe->fit->camera_size(0));
}

TEST_CASE("of a resize in floats the middle is kept") {
  const ResizeFilter* const bilinear = find_resize_filter("resize_floats", "bilinear");
  const Frame frame = frame_of(5, 4);
  const std::vector<float> whole = resized(frame, {{}, {{7, 3, bilinear}}, {}});
  const FloatResizes cropped = {{}, {{7, 3, bilinear}}, CameraSize{4, 2}};
  std::vector<float> out(3 * 4 * 2, NAN);
  REQUIRE(resize_floats(frame, cropped, out, "top").ok());
  for (std::size_t c = 0; c < 3; ++c)
    for (std::size_t y = 0; y < 2; ++y)
      for (std::size_t x = 0; x < 4; ++x)  // of 3 columns 2 are left of it, of 1 row none is above: half to even
        CHECK(out[(c * 2 + y) * 4 + x] == whole[(c * 3 + y) * 7 + x + 2]);
}

TEST_CASE("what the document does not say of resize_floats is refused") {
  const auto refused = [](const Json& image) { return refusal(parsed(image), Code::bad_bundle); };
  const Json size = size_op(4, 4, "area"), clip = {{"op", "clip"}, {"low", 0}, {"high", 1}};
  CHECK(contains(refused(Json::array({size_op(4, 4, "lanczos")})), "image[0].filter"));
  CHECK(contains(refused(Json::array({size_op(1, 4, "area")})), "image[0].width: expected an integer from 2"));
  CHECK(contains(refused(Json::array({size_op(8192, 8192, "area")})), "image[0].height: expected at most 64000000"));
  CHECK(contains(refused(Json::array({size, clip, size})), "image[2].op: expected resize_floats as the first ops"));
  CHECK(contains(refused(Json::array({{{"op", "square_pad"}}, size})), "image[1].op"));
  CHECK(contains(refused(Json(5, size)), "image[4].op: expected fewer sizes"));
  const Json crop = {{"op", "crop_floats"}, {"width", 3}, {"height", 2}};
  CHECK(contains(refused(Json::array({crop})), "image[0].op: expected crop_floats once, behind resize_floats"));
  CHECK(contains(refused(Json::array({size, crop, crop})), "image[2].op"));
  CHECK(contains(refused(Json::array({size, crop, size})), "image[2].op"));
  CHECK(contains(refused(Json::array({size, {{"op", "crop_floats"}, {"width", 5}, {"height", 2}}})), "image[1].width"));
  Json late = size;
  late.update({{"from_width", 4}, {"from_height", 4}});
  CHECK(contains(refused(Json::array({size, late})), "image[1].from_"));
}

}  // namespace resize_floats_test
