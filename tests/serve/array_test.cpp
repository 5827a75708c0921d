// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Arrays of every type, width and byte order, alone and through the front ends that take them: read rightly, or refused
// with a type that works.
#include "serve/array.h"

#include <doctest/doctest.h>

#include <bit>
#include <cmath>
#include <functional>
#include <map>

#include "fuzz/lerobot_target.h"
#include "serve/msgpack/writer.h"
#include "support/pickled.h"

namespace array_test {

using namespace vla;
using namespace vla::serve;

namespace {

constexpr char kKinds[] = "?bBhHiIlLqQefdgFDGucSUVOMma";
constexpr int kWidths[] = {0, 1, 2, 3, 4, 8, 12, 16, 32, 65536};
constexpr char kOrders[] = "<>|=!";

template <class T>
std::string encoded(double value, bool is_big) {
  const auto exact = static_cast<T>(value);
  std::string bytes(sizeof(T), '\0');
  std::memcpy(bytes.data(), &exact, sizeof(T));
  if (is_big) std::reverse(bytes.begin(), bytes.end());
  return bytes;
}

/// Of the numbers of these tests, which are whole and small.
std::string encoded_half(double value, bool is_big) {
  int exponent = 0;
  const double fraction = std::frexp(value, &exponent);
  const auto bits =
      static_cast<std::uint16_t>(value == 0 ? 0 : (exponent + 14) << 10 | static_cast<int>(fraction * 2048) % 1024);
  return encoded<std::uint16_t>(bits, is_big);
}

/// A number as bytes of a type by its letters; empty where that type has no numbers or is not taken.
std::string encoded(const std::string& letters, double value, bool is_big) {
  using Encode = std::string (*)(double, bool);
  const std::map<std::string, Encode> types = {
      {"b1", encoded<std::uint8_t>},  {"i1", encoded<std::int8_t>},   {"i2", encoded<std::int16_t>},
      {"i4", encoded<std::int32_t>},  {"i8", encoded<std::int64_t>},  {"u1", encoded<std::uint8_t>},
      {"u2", encoded<std::uint16_t>}, {"u4", encoded<std::uint32_t>}, {"u8", encoded<std::uint64_t>},
      {"f2", encoded_half},           {"f4", encoded<float>},         {"f8", encoded<double>}};
  const auto found = types.find(letters);
  return found == types.end() ? std::string() : found->second(value, is_big);
}

bool is_order(char order, const std::string& letters) {
  return order == '<' || order == '>' || (order == '|' && letters.ends_with('1'));
}

/// Calls `check` with each letter, width and byte order.
void for_all_types(const std::function<void(const std::string& letters, char order)>& check) {
  for (const char kind : std::string_view(kKinds))
    for (const int width : kWidths)
      for (const char order : std::string_view(kOrders)) {
        const std::string letters = kind + std::to_string(width);
        CAPTURE(letters);
        CAPTURE(order);
        check(letters, order);
      }
}

/// The words of a refusal may quote what was sent as a type, never what lies in memory.
void check_words(const Error& error, const std::string& letters) {
  CHECK(error.message().size() < 400);
  if (error.found.starts_with("dtype")) {
    CHECK(error.found.find(letters) != std::string::npos);
    CHECK((error.expected + error.hint).find("float32") != std::string::npos);
  }
}

Result<Frame> from_openpi(const std::string& letters, char order, const std::vector<std::int64_t>& shape,
                          const std::string& data) {
  static std::string message;
  msgpack::Writer out;
  out.map(4).bytes("__ndarray__").boolean(true).bytes("data").bytes(data).bytes("dtype").text(order + letters);
  out.bytes("shape").list(shape.size());
  for (const std::int64_t size : shape) out.integer(size);
  message = out.take();
  const auto value = msgpack::read(std::as_bytes(std::span(message)));
  REQUIRE(value);
  VLA_TRY(const Array array, msgpack::array_of(*value, "camera"));
  return frame_of(array, "camera", {100, Code::too_large}, false);
}

Result<Frame> from_lerobot(test::PickledArray image) {
  static const v1::Description policy = fuzz::small_policy();
  static const Names names =
      *lerobot::lerobot_names({"", {"observation.images.image=image", "observation.images.wrist="}, {}}, policy);
  static const lerobot::Setup setup{{"arm.0", "arm.1", "hand"}, {{"image", &names.views[0]}}, 2};
  const std::string bytes = test::pickled_observation(image);
  VLA_TRY(const pickle::Pickle message, pickle::Pickle::read(std::as_bytes(std::span(bytes))));
  VLA_TRY(const lerobot::Observed observed, lerobot::read_observation(message, setup));
  VLA_TRY(const v1::Act act, lerobot::act_of(message, observed, setup, names, fuzz::small_limits()));
  return *fuzz::served(act).views.at("observation.images.image");
}

std::vector<int> pixels(const Frame& frame) {
  const auto& values = std::get<std::vector<std::uint8_t>>(frame.rgb);
  return {values.begin(), values.end()};
}

/// Whether every front end makes pixels of this type, which are then right.
void check_frame(const Result<Frame>& frame, const std::string& letters, bool is_taken) {
  REQUIRE(frame.ok() == is_taken);
  if (!frame) return check_words(frame.error(), letters);
  CHECK((frame->width == 2 && frame->height == 1));
  CHECK(pixels(*frame) ==
        (letters == "u1" ? std::vector<int>{0, 1, 1, 0, 1, 0} : std::vector<int>{0, 255, 255, 0, 255, 0}));
}

}  // namespace

TEST_CASE("every type of elements is read rightly or refused with one that works") {
  int n_taken = 0;
  for_all_types([&](const std::string& letters, char order) {
    const auto type = ElementType::read(order + letters, "state");
    const std::string one = encoded(letters, 1, order == '>');
    const bool is_text = letters[0] == 'U' && letters != "U0" && letters != "U65536" && (order == '<' || order == '>');
    REQUIRE(type.ok() == ((!one.empty() && is_order(order, letters)) || is_text));
    if (!type) return check_words(type.error(), letters);
    if (is_text) return;
    ++n_taken;
    std::string data;
    for (const double value : {0, 1, 100}) data += encoded(letters, value, order == '>');
    const auto array = Array::make(*type, {1, 3}, data, "state");
    REQUIRE(array);
    CHECK(array->count() == 3);
    const auto row = row_of(*array, "state");
    REQUIRE(row);
    CHECK(*row == (letters == "b1" ? std::vector<float>{0, 1, 1} : std::vector<float>{0, 1, 100}));
    for (const std::string& wrong : {data.substr(1), data + data[0], std::string()}) {
      const auto refused = Array::make(*type, {1, 3}, wrong, "state");
      REQUIRE(!refused);
      check_words(refused.error(), letters);
    }
  });
  CHECK(n_taken == 3 * 3 + 9 * 2);
}

TEST_CASE("large numbers of every width keep sign and value in both byte orders") {
  for (const char order : {'<', '>'}) {
    const auto number = [&](const char* letters, auto value) {
      const auto type = ElementType::read(order + std::string(letters), "");
      std::string data(sizeof value, '\0');
      std::memcpy(data.data(), &value, sizeof value);
      if (order == '>') std::reverse(data.begin(), data.end());
      return row_of(*Array::make(*type, {}, data, ""), "")->at(0);
    };
    CHECK(number("i1", std::int8_t{-128}) == -128);
    CHECK(number("i2", std::int16_t{-32768}) == -32768);
    CHECK(number("i4", std::int32_t{-2147483647}) == -2147483647.0f);
    CHECK(number("i8", INT64_MIN) == -9223372036854775808.0f);
    CHECK(number("u2", std::uint16_t{65535}) == 65535);
    CHECK(number("u4", std::uint32_t{0xFFFFFFFF}) == 4294967295.0f);
    CHECK(number("u8", UINT64_MAX) == 18446744073709551615.0f);
    CHECK(number("f2", std::uint16_t{0xBE00}) == -1.5f);
    CHECK(number("f2", std::uint16_t{0x7BFF}) == 65504.0f);
    CHECK(number("f2", std::uint16_t{0x0001}) == 0x1p-24f);
    CHECK(number("f2", std::uint16_t{0xFC00}) == -INFINITY);
    CHECK(number("f4", -1.5f) == -1.5f);
    CHECK(number("f8", -1.25) == -1.25f);
  }
}

TEST_CASE(
    "shapes of zero, of too many dimensions, below zero or beyond any memory ask for their bytes or are refused") {
  const ElementType type = *ElementType::read("<f8", "");
  CHECK(Array::make(type, {0, 7}, "", "")->count() == 0);
  CHECK(row_of(*Array::make(type, {0}, "", ""), "")->empty());
  CHECK(Array::make(type, {}, std::string(8, '\0'), ""));
  const std::int64_t most = INT64_MAX;
  for (const std::vector<std::int64_t>& shape : std::vector<std::vector<std::int64_t>>{{-1},
                                                                                       {most},
                                                                                       {most, most},
                                                                                       {1 << 30, 1 << 30, 1 << 30},
                                                                                       {-1, -1},
                                                                                       {2, most / 2 + 1},
                                                                                       {0, -1},
                                                                                       {1, 1, 1, 1, 1, 1, 1, 1, 1}})
    CHECK(!Array::make(type, shape, std::string(8, '\0'), ""));
  CHECK(!frame_of(*Array::make(*ElementType::read("|u1", ""), {0, 2, 3}, "", ""), "", {100}, false));
}

TEST_CASE("frames of every type become pixels in each front end, or are refused there with a type that works") {
  for_all_types([](const std::string& letters, char order) {
    std::string data;
    for (const double value : {0, 1, 1, 0, 1, 0}) data += encoded(letters, value, order == '>');
    if (data.empty()) data.resize(6 * static_cast<std::size_t>(std::stoi(letters.substr(1)) % 64), '?');
    const bool is_pixel = letters == "u1" || letters == "f2" || letters == "f4" || letters == "f8";
    const bool is_taken = is_pixel && is_order(order, letters);
    const std::vector<std::int64_t> shape = {1, 2, 3};
    check_frame(from_openpi(letters, order, shape, data), letters, is_taken);
    for (const bool by_buffer : {false, true}) {
      const test::PickledArray image{letters, std::string(1, order), shape, data, false, by_buffer};
      check_frame(from_lerobot(image), letters, is_taken);
      if (data.empty()) continue;
      for (const std::string& wrong : {data.substr(1), data + "?"}) {
        auto other = image;
        other.data = wrong;
        CHECK(!from_lerobot(other));
        CHECK(!from_openpi(letters, order, shape, wrong));
      }
      auto fortran = image;
      fortran.is_fortran = true;
      const auto refused = from_lerobot(fortran);
      REQUIRE(!refused);
      if (is_taken) CHECK(refused.error().hint.find("ascontiguousarray") != std::string::npos);
    }
  });
}

TEST_CASE("a frame in half precision has the bytes of its own arithmetic") {
  // NumPy 2.2: (255 * numpy.float16(x)).astype(numpy.uint8) of these bits.
  const std::pair<std::uint16_t, int> cases[] = {{0x3800, 127}, {0x3BFF, 254}, {0x3BF8, 254}, {0x1C04, 1},
                                                 {0x1C02, 0},   {0x3A46, 200}, {0x3001, 31},  {0x0001, 0}};
  for (const auto& [bits, byte] : cases) {
    CAPTURE(bits);
    std::string data;
    for (int i = 0; i < 3; ++i) data += encoded<std::uint16_t>(bits, false);
    const auto frame = from_lerobot({"f2", "<", {1, 1, 3}, data});
    REQUIRE(frame);
    CHECK(pixels(*frame) == std::vector<int>(3, byte));
  }
  CHECK(!from_lerobot({"f2", "<", {100, 41, 3}, std::string(2 * 100 * 41 * 3, '\xFF')}));
}

}  // namespace array_test
