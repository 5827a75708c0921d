// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/ops/resize.h"

#include "base/npy.h"
#include "processor/images.h"
#include "processor/ops/planes.h"
#include "processor/resample.h"

namespace resize_test {

using namespace vla;
using namespace vla::test;

namespace {

const ResizeFilter* filter_of(std::string_view name) { return find_resize_filter("resize", name); }

std::vector<float> resized(const Frame& frame, const Resize& to) {
  std::vector<float> out(static_cast<std::size_t>(3 * to.width * to.height), NAN);
  const Status status = resize(frame, to, out, "top");
  REQUIRE_MESSAGE(status.ok(), status.error().message());
  return out;
}

}  // namespace

TEST_CASE("resize equals OpenCV and torch byte for byte, up, down and to half") {
  const std::string file = read_text(data_path("resize.npy"));
  const auto bytes = parse_npy(bytes_of(file), "resize.npy");
  REQUIRE(bytes.ok());
  std::span<const std::uint8_t> rest = std::get<std::vector<std::uint8_t>>(bytes->values);
  int compared = 0;
  for (const auto& sizes : data_json("resize.json")) {
    CAPTURE(sizes.dump());
    const Frame frame = frame_of(sizes[0], sizes[1]);
    const Resize to{sizes[2], sizes[3], filter_of(sizes[4].get<std::string>())};
    const std::vector<float> found = resized(frame, to);
    const std::size_t size = found.size() / 3;
    bool equal = true;
    for (std::size_t i = 0; i < size; ++i)
      for (std::size_t c = 0; c < 3; ++c) equal &= found[c * size + i] == static_cast<float>(rest[3 * i + c]) / 255.0f;
    CHECK(equal);
    if (to.filter->cuts_floats) CHECK(found == resized(as_floats(frame), to));
    rest = rest.subspan(found.size());
    ++compared;
  }
  CHECK(rest.empty());
  CHECK(compared == 28);
}

TEST_CASE("torch's bilinear filter blends two neighbours in each direction and rounds nothing") {
  const Frame frame{2, 1, std::vector<std::uint8_t>{0, 51, 255, 102, 51, 255}};
  const auto near = [](float x) { return doctest::Approx(x).epsilon(1e-6); };
  for (const Frame& given : {frame, as_floats(frame)}) {
    const std::vector<float> out = resized(given, {4, 2, filter_of("torch_bilinear")});
    for (const std::size_t row : {0, 4}) {
      CHECK(out[row] == 0.0f);
      CHECK(out[row + 1] == near(0.1f));
      CHECK(out[row + 2] == near(0.3f));
      CHECK(out[row + 3] == 0.4f);
      CHECK(out[8 + row + 1] == 0.2f);
    }
    CHECK(resized(given, {2, 1, filter_of("torch_bilinear")}) ==
          std::vector<float>{0.0f, 0.4f, 0.2f, 0.2f, 1.0f, 1.0f});
  }
}

TEST_CASE("pixels as floats are cut to bytes for torch's filter and refused for OpenCV's") {
  const Frame frame{2, 2, std::vector<float>{0.999f, 0.5f, 0.0f, 1.0f, 0.25f, 0.002f, 0, 0, 0, 0, 0, 0}};
  const std::vector<float> out = resized(frame, {2, 2, filter_of("torch_bicubic_8bit")});
  CHECK(out[0] == 254.0f / 255.0f);
  CHECK(out[1] == 1.0f);
  CHECK(out[4] == 127.0f / 255.0f);
  CHECK(out[9] == 0.0f);
  std::vector<float> untouched(12);
  CHECK(contains(refusal(resize(frame, {2, 2, filter_of("opencv_bilinear")}, untouched, "top"), Code::bad_observation),
                 "top: expected pixels of 8 bits, found float pixels"));
}

TEST_CASE("an image of the size keeps its bytes under both filters") {
  const Frame frame = frame_of(5, 4);
  const auto& rgb = std::get<std::vector<std::uint8_t>>(frame.rgb);
  CHECK(resample_opencv(rgb, 5, 4, 5, 4) == rgb);
  CHECK(resample_torch(rgb, 5, 4, 5, 4) == rgb);
}

TEST_CASE("each combination of growing and shrinking has the bytes of Pillow 13.0") {
  struct Case {
    int width, height, to_width, to_height;
    const char* filter;
    std::vector<std::uint8_t> expected;
  };
  // Of 6 x 9, four rows lost are no more than twice the two columns lost, seven are.
  const Case cases[] = {
      {3, 9, 4, 2, "pillow_bicubic", {25, 54,  83,  30, 59,  88,  38, 67,  96,  43,  72,  101,
                                      78, 107, 136, 86, 115, 144, 98, 127, 156, 106, 135, 164}},
      {6, 9, 4, 2, "pillow_bicubic", {28, 57,  86,  40,  69,  98,  55,  84,  113, 66,  95,  124,
                                      83, 112, 141, 101, 130, 159, 111, 140, 169, 120, 149, 178}},
      {6, 9, 4, 5, "pillow_bicubic", {8,   37,  66,  18,  47,  76,  30,  59,  88,  41,  70,  99,  31,  60,  89,
                                      43,  72,  101, 58,  87,  116, 71,  100, 129, 55,  84,  113, 71,  100, 129,
                                      88,  117, 146, 94,  123, 152, 80,  109, 138, 97,  126, 155, 106, 135, 164,
                                      117, 146, 175, 102, 131, 160, 122, 151, 180, 131, 160, 189, 139, 168, 197}},
      {6, 2, 3, 3, "pillow_bicubic", {3,  32, 61, 17, 46, 75, 30, 59, 88, 11, 40, 69, 26, 55,
                                      84, 40, 69, 98, 18, 47, 76, 34, 63, 92, 50, 79, 108}},
      {3, 2, 4, 3, "pillow_bicubic", {0,  28, 57, 3,  32, 61, 9,  38, 67, 13, 42, 71, 7,  36, 65, 11, 40, 69,
                                      18, 47, 76, 22, 51, 80, 14, 43, 72, 18, 47, 76, 26, 55, 84, 30, 59, 88}},
      {3, 9, 4, 2, "pillow_bilinear", {28, 57,  86,  34, 63,  92,  41, 70,  99,  47,  76,  105,
                                       76, 105, 134, 84, 113, 142, 93, 122, 151, 101, 130, 159}},
      {6, 5, 4, 3, "pillow_bilinear", {9,  38, 67,  18, 47, 76,  30, 59, 88,  40, 69, 98,  29, 58,  87,  42, 71,  100,
                                       55, 84, 113, 68, 97, 126, 50, 79, 108, 66, 95, 124, 80, 109, 138, 89, 118, 147}},
  };
  for (const Case& c : cases) {
    CAPTURE(c.to_width);
    CAPTURE(c.to_height);
    const Frame frame = frame_of(c.width, c.height);
    const auto& rgb = std::get<std::vector<std::uint8_t>>(frame.rgb);
    const auto resample =
        c.filter == std::string("pillow_bilinear") ? resample_pillow_bilinear : resample_pillow_bicubic;
    CHECK(resample(rgb, c.width, c.height, c.to_width, c.to_height) == c.expected);
  }
}

TEST_CASE("standardize equals torch on every byte in each arithmetic") {
  const std::string file = read_text(data_path("standardize.npy"));
  const auto expected = parse_npy(bytes_of(file), "standardize.npy");
  REQUIRE(expected.ok());
  std::span<const float> rest = std::get<std::vector<float>>(expected->values);
  REQUIRE(rest.size() == 3 * 3 * 256);
  Standardize op{{0.485f, 0.456f, 0.406f}, {0.229f, 0.224f, 0.225f}, Standardize::Arithmetic::float32};
  using Arithmetic = Standardize::Arithmetic;
  for (const auto arithmetic : {Arithmetic::float32, Arithmetic::bfloat16, Arithmetic::float32_then_bfloat16}) {
    std::vector<float> pixels;
    for (int i = 0; i < 3 * 256; ++i) pixels.push_back(static_cast<float>(i % 256) / 255.0f);
    op.arithmetic = arithmetic;
    standardize(pixels, op);
    CHECK(std::equal(pixels.begin(), pixels.end(), rest.begin()));
    rest = rest.subspan(pixels.size());
  }
}

}  // namespace resize_test
