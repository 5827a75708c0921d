// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/ops/letterbox.h"
#include "processor/ops/planes.h"

#include <cmath>

#include "base/npy.h"
#include "processor/images.h"

namespace letterbox_test {

using namespace vla;
using namespace vla::test;

namespace {

std::vector<float> boxed(const Frame& frame, const Letterbox& box) {
  std::vector<float> out(static_cast<std::size_t>(3 * box.width * box.height), NAN);
  REQUIRE(letterbox(frame, box, out, "f").ok());
  return out;
}

std::vector<float> boxed(const Frame& frame, int width, int height, float fill = 0.0f) {
  return boxed(frame, Letterbox{width, height, {fill, fill, fill}});
}

}  // namespace

TEST_CASE("letterbox and affine equal torch and Pillow bit for bit at every size and aspect") {
  const std::string file = read_text(data_path("letterbox.npy"));
  const auto planes = parse_npy(bytes_of(file), "letterbox.npy");
  REQUIRE(planes.ok());
  std::span<const float> rest = std::get<std::vector<float>>(planes->values);
  for (const auto& sizes : data_json("letterbox.json")) {
    CAPTURE(sizes.dump());
    const Frame frame = frame_of(sizes[0], sizes[1]);
    Letterbox box{sizes[2], sizes[3]};
    if (sizes[4] != "bottom_right") box.align = Letterbox::Align::center;
    box.antialias = sizes[4] == "pillow";
    std::vector<float> found = boxed(frame, box);
    // 255 x, cut to whole numbers, does not always give the byte back that was divided by 255.
    if (!box.antialias) CHECK(found == boxed(as_floats(frame), box));
    if (sizes[4] == "center") clip(found, 0.0f, 1.0f);
    affine(found, 2.0f, -1.0f);
    const auto expected = rest.first(found.size());
    CHECK(std::equal(found.begin(), found.end(), expected.begin()));
    rest = rest.subspan(found.size());
  }
  CHECK(rest.empty());
}

TEST_CASE("rows that are made alone, in any order, are those of the whole image, and no others are touched") {
  for (const auto align : {Letterbox::Align::bottom_right, Letterbox::Align::center})
    for (const auto& [width, height] : {std::pair{9, 4}, {4, 9}, {23, 16}, {40, 31}, {16, 12}}) {
      const Letterbox box{16, 12, {0.25f, 0.5f, 0.75f}, align};
      const Frame frame = frame_of(width, height);
      const std::vector<float> whole = boxed(frame, box);
      std::vector<float> made(whole.size(), 9.0f);
      for (const Rows rows : {Rows{7, 12}, {0, 1}, {1, 7}}) {
        const std::vector<float> before = made;
        REQUIRE(letterbox_rows(frame, box, rows, made, "f").ok());
        for (std::size_t i = 0; i < made.size(); ++i) {
          const int row = static_cast<int>(i) / box.width % box.height;
          CHECK(made[i] == (row >= rows.first && row < rows.end ? whole : before)[i]);
        }
      }
    }
}

TEST_CASE("letterbox puts the image at the bottom right and fills the rest") {
  const Frame white{1, 2, std::vector<std::uint8_t>(6, 255)};
  const std::vector<float> wide = boxed(white, 4, 4, 0.25f);  // 2 x 4 of the 4 x 4
  CHECK(wide[1] == 0.25f);
  CHECK(wide[2] == 1.0f);
  const Frame flat{2, 1, std::vector<std::uint8_t>(6, 255)};
  const std::vector<float> tall = boxed(flat, 4, 4, 0.25f);
  CHECK(tall[7] == 0.25f);
  CHECK(tall[8] == 1.0f);
}

TEST_CASE("a centred image leaves the smaller half of an odd rest at the left and at the top") {
  Letterbox box{5, 2, {0.25f, 0.25f, 0.25f}, Letterbox::Align::center};
  const std::vector<float> wide = boxed({1, 1, std::vector<std::uint8_t>(3, 255)}, box);  // 2 x 2 of the 5 x 2
  CHECK(std::vector<float>(wide.begin(), wide.begin() + 5) == std::vector<float>{0.25f, 1.0f, 1.0f, 0.25f, 0.25f});
  box = {2, 5, {0.25f, 0.25f, 0.25f}, Letterbox::Align::center};
  const std::vector<float> tall = boxed({1, 1, std::vector<std::uint8_t>(3, 255)}, box);
  CHECK(tall[0] == 0.25f);
  CHECK(tall[2] == 1.0f);
  CHECK(tall[6] == 0.25f);
}

TEST_CASE("what is beside an image has a number for each channel") {
  Letterbox box{2, 1, {0.25f, 0.5f, 0.75f}};
  box.align = Letterbox::Align::bottom_right;
  const std::vector<float> out = boxed({1, 1, std::vector<std::uint8_t>(3, 255)}, box);
  CHECK(out == std::vector<float>{0.25f, 1.0f, 0.5f, 1.0f, 0.75f, 1.0f});
}

TEST_CASE("antialiasing cuts float frames to bytes, also at the right size") {
  Letterbox box{2, 1, {}, Letterbox::Align::center, true};
  const Frame frame{2, 1, std::vector<float>{0.999f, 0.5f, 0.0f, 1.0f, 0.25f, 0.002f}};
  const std::vector<float> out = boxed(frame, box);
  CHECK(out[0] == 254.0f / 255.0f);
  CHECK(out[1] == 1.0f);
  CHECK(out[2] == 127.0f / 255.0f);
  CHECK(out[5] == 0.0f);
}

TEST_CASE("clip holds values in its range") {
  std::vector<float> values = {-0.5f, 0.0f, 0.5f, 1.0f, std::nextafter(1.0f, 2.0f)};
  clip(values, 0.0f, 1.0f);
  CHECK(values == std::vector<float>{0.0f, 0.0f, 0.5f, 1.0f, 1.0f});
}

TEST_CASE("a frame of the right size is copied untouched") {
  const Frame frame = frame_of(5, 3);
  const std::vector<float> out = boxed(frame, 5, 3);
  const auto& rgb = std::get<std::vector<std::uint8_t>>(frame.rgb);
  CHECK(out[15 + 7] == static_cast<float>(rgb[7 * 3 + 1]) / 255.0f);
}

TEST_CASE("an image too narrow to leave a pixel is refused") {
  std::vector<float> out(3 * 16 * 16);
  CHECK(contains(refusal(letterbox(frame_of(1000, 2), Letterbox{16, 16}, out, "top"), Code::bad_observation), "top: "));
  refusal(letterbox(frame_of(2, 1000), Letterbox{16, 16}, out, "top"), Code::bad_observation);
}

TEST_CASE("affine rounds the product before it adds") {
  std::vector<float> values = {0.1f};
  affine(values, 3.0f, -0.3f);
  volatile float product = 0.1f * 3.0f;
  CHECK(values[0] == product - 0.3f);
  CHECK(values[0] != std::fma(0.1f, 3.0f, -0.3f));
}

}  // namespace letterbox_test
