// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Messages of openpi's and GR00T's clients: what the clients' own packages wrote, and what nobody should write.
#include <doctest/doctest.h>

#include <algorithm>
#include <filesystem>
#include <fstream>
#include <iterator>

#include "fuzz/message_target.h"
#include "serve/msgpack/writer.h"
#include "support/editable_bundle.h"

namespace message_test {

using namespace vla;
using msgpack::Framing;
using msgpack::Value;
using msgpack::Writer;

namespace {

std::span<const std::byte> bytes_of(const std::string& text) { return std::as_bytes(std::span(text)); }

Error refusal(const std::string& message) {
  const auto read = msgpack::read(bytes_of(message));
  REQUIRE_FALSE(read.ok());
  CHECK(read.error().code == Code::bad_request);
  return read.error();
}

std::string seed_of(const std::string& name) {
  return test::read_text(test::source_path("tests/fuzz/regressions/" + name));
}

serve::Names names(const std::vector<std::string>& lines, const std::string& preset = "") {
  const auto made = serve::names_for({preset, lines, {}}, fuzz::small_policy(), "--openpi");
  REQUIRE_MESSAGE(made.ok(), (made ? "" : made.error().message()));
  return *made;
}

const std::vector<std::string> kLines = {"observation/image=image", "observation/wrist_image=wrist",
                                         "observation/state=arm"};

Result<Observation> read_act(const std::string& message, const serve::Names& by) {
  static std::string kept;
  kept = message;
  const auto value = msgpack::read(bytes_of(kept));
  REQUIRE(value.ok());
  return serve::observe(*value, by, fuzz::kMessageLimits);
}

std::string frame_message(const std::string& dtype, const std::vector<int>& shape, const std::string& data) {
  Writer out;
  out.map(4).bytes("__ndarray__").boolean(true).bytes("data").bytes(data).bytes("dtype").text(dtype);
  out.bytes("shape").list(shape.size());
  for (const int size : shape) out.integer(size);
  return out.take();
}

Result<Frame> frame_of(const std::string& message, bool is_bgr = false) {
  const auto value = msgpack::read(bytes_of(message));
  REQUIRE(value.ok());
  const auto array = msgpack::array_of(*value, "camera");
  if (!array) return array.error();
  return serve::frame_of(*array, "camera", {100}, is_bgr);
}

std::vector<int> pixels(const Result<Frame>& frame) {
  REQUIRE_MESSAGE(frame.ok(), (frame ? "" : frame.error().message()));
  const auto& values = std::get<std::vector<std::uint8_t>>(frame->rgb);
  return {values.begin(), values.end()};
}

}  // namespace

TEST_CASE("a message is one whole value with text or bytes as keys, each once") {
  CHECK(msgpack::read(bytes_of(std::string("\x80", 1))).ok());
  CHECK(msgpack::read(bytes_of(std::string("\x90", 1))).ok());
  refusal("");
  refusal("\x81");
  refusal(std::string("\x80\x80", 2));
  refusal(std::string("\x81\x01\x01", 3));  // a number as key
  refusal(
      std::string("\x82\xa1"
                  "a\x01\xa1"
                  "a\x02",
                  7));                      // one key twice
  refusal(std::string("\xd4\x01\x01", 3));  // an extension type
  refusal(std::string("\xa1\xff", 2));      // text that is not UTF-8
  refusal(std::string("\xcf\xff\xff\xff\xff\xff\xff\xff\xff", 9));
}

TEST_CASE("what a message announces takes no memory before it came") {
  const fuzz::Budget budget(2, 16);
  CHECK(refusal(std::string("\xdd\xff\xff\xff\xff", 5)).expected == "fewer values");
  CHECK(refusal(std::string("\xdf\xff\xff\xff\xff", 5)).expected == "fewer values");
  CHECK(refusal(std::string(1000, '\x91')).expected == "fewer levels");
  refusal(std::string("\xc6\xff\xff\xff\xff", 5));
  refusal(std::string("\xdb\xff\xff\xff\xff", 5));
}

TEST_CASE("texts are bounded together, and each before its bytes are looked at") {
  const auto list_of = [](std::size_t n, char letter) {
    std::string text("\xdb\0\x10\0\0", 5);
    text.append(1 << 20, letter);
    std::string message(1, static_cast<char>(0x90 + n));
    for (std::size_t i = 0; i < n; ++i) message += text;
    return message;
  };
  CHECK(msgpack::read(bytes_of(list_of(2, 'x'))).ok());
  CHECK(refusal(list_of(3, 'x')).expected == "fewer bytes of text");
  CHECK(refusal(std::string("\xdb\0\x20\0\1", 5) + std::string((2 << 20) + 1, '\xff')).expected ==
        "fewer bytes of text");
}

TEST_CASE("what the clients' packages write is read, in every framing of arrays") {
  int n_act = 0;
  for (const auto& file : std::filesystem::directory_iterator(test::source_path("tests/fuzz/regressions/openpi"))) {
    CAPTURE(file.path());
    const std::string bytes = test::read_text(file.path());
    const bool is_act = fuzz::check_openpi(bytes_of(bytes));
    if (!file.path().filename().string().starts_with("act")) continue;
    CHECK(is_act);
    ++n_act;
  }
  CHECK(n_act == 8);
  n_act = 0;
  for (const auto& file : std::filesystem::directory_iterator(test::source_path("tests/fuzz/regressions/gr00t"))) {
    CAPTURE(file.path());
    if (!file.path().filename().string().starts_with("n1")) continue;
    CHECK(fuzz::check_gr00t(bytes_of(test::read_text(file.path()))));
    ++n_act;
  }
  CHECK(n_act == 4);
}

TEST_CASE("the three releases of GR00T's client are told apart") {
  const auto dialect = [](const char* name) {
    static std::string message;
    message = seed_of(std::string("gr00t/") + name);
    const auto value = msgpack::read(bytes_of(message));
    return serve::gr00t::read_observation(value->find("data"))->dialect;
  };
  const auto n1_5 = dialect("n1_5"), n1_6 = dialect("n1_6"), n1_7 = dialect("n1_7"), flat = dialect("n1_7_flat");
  CHECK((n1_5.is_n1_5 && n1_5.is_flat && !n1_5.is_batched && n1_5.framing == Framing::npy));
  CHECK((!n1_6.is_n1_5 && !n1_6.is_flat && n1_6.is_batched && n1_6.framing == Framing::npy));
  CHECK((!n1_7.is_n1_5 && !n1_7.is_flat && n1_7.is_batched && n1_7.framing == Framing::numpy));
  CHECK((!flat.is_n1_5 && flat.is_flat && flat.is_batched && flat.framing == Framing::numpy));
}

TEST_CASE("frames are rows of colours or planes of them, and BGR when a line says so") {
  const std::string rows("\1\2\3\4\5\6", 6);
  CHECK(pixels(frame_of(frame_message("|u1", {1, 2, 3}, rows))) == std::vector<int>{1, 2, 3, 4, 5, 6});
  CHECK(pixels(frame_of(frame_message("|u1", {1, 1, 1, 2, 3}, rows))) == std::vector<int>{1, 2, 3, 4, 5, 6});
  CHECK(pixels(frame_of(frame_message("|u1", {3, 1, 2}, rows))) == std::vector<int>{1, 3, 5, 2, 4, 6});
  CHECK(pixels(frame_of(frame_message("|u1", {1, 2, 3}, rows), true)) == std::vector<int>{3, 2, 1, 6, 5, 4});
  const float values[] = {0.0f, 0.5f, 1.0f};
  const std::string floats(reinterpret_cast<const char*>(values), sizeof values);
  CHECK(pixels(frame_of(frame_message("<f4", {1, 1, 3}, floats))) == std::vector<int>{0, 127, 255});
}

TEST_CASE("arrays that are not what they say are refused") {
  const std::string rows(6, '\1');
  CHECK_FALSE(frame_of(frame_message("|u1", {2, 2, 3}, rows)).ok());
  CHECK_FALSE(frame_of(frame_message("|O", {1, 2, 3}, rows)).ok());
  CHECK_FALSE(frame_of(frame_message("<c8", {1, 2, 3}, rows)).ok());
  CHECK_FALSE(frame_of(frame_message("", {1, 2, 3}, rows)).ok());
  CHECK_FALSE(frame_of(frame_message("|u1", {-1, 2, 3}, rows)).ok());
  CHECK_FALSE(frame_of(frame_message("|u1", {0, 2, 3}, "")).ok());
  CHECK_FALSE(frame_of(frame_message("|u1", {2, 3}, rows)).ok());
  CHECK_FALSE(frame_of(frame_message("|u1", {2, 1, 1, 3}, rows)).ok());
  CHECK_FALSE(frame_of(frame_message("<u4", {1, 1, 3}, std::string(12, '\0'))).ok());
  const float two[] = {2.0f, 0.0f, 0.0f};
  CHECK_FALSE(frame_of(frame_message("<f4", {1, 1, 3}, {reinterpret_cast<const char*>(two), sizeof two})).ok());
  CHECK(frame_of(frame_message("|u1", {20, 20, 3}, std::string(1200, '\1'))).error().where == "camera");
  CHECK_FALSE(frame_of(frame_message("<i8", {1 << 30, 1 << 30, 1 << 30, 3}, rows)).ok());
}

TEST_CASE("degrees become radians, a flipped gripper 1 - x, and actions come back the other way") {
  const std::string message = seed_of("openpi/act");
  auto by = names({kLines[0], kLines[1], "observation/state=arm,degrees"});
  const auto observation = read_act(message, by);
  REQUIRE_MESSAGE(observation.ok(), (observation ? "" : observation.error().message()));
  CHECK(observation->states.at("state.arm")[2] == doctest::Approx(2 * 3.14159265 / 180));
  by = names({kLines[0], kLines[1], kLines[2], "actions=0:2,degrees", "actions=2:3,flipped"});
  std::vector<float> actions = {3.14159265f, 0, 0.25f, 0, 3.14159265f, 1};
  by.to_client(actions, 3);
  CHECK(actions[0] == doctest::Approx(180));
  CHECK(actions[2] == 0.75f);
  CHECK(actions[4] == doctest::Approx(180));
  CHECK(actions[5] == 0.0f);
  CHECK(by.told() ==
        "observation/image=image(rgb) observation/wrist_image=wrist(rgb) observation/state=arm(radians) "
        "actions=0:2(degrees) actions=2:3(radians,flipped)");
}

TEST_CASE("names that leave something out, or that fit nothing, are refused with both lists") {
  const auto refused = [](const std::vector<std::string>& lines, const std::string& preset = "") {
    const auto made = serve::names_for({preset, lines, {}}, fuzz::small_policy(), "--openpi");
    REQUIRE_FALSE(made.ok());
    CHECK(made.error().code == Code::usage);
    CHECK(made.error().hint.find("observation.images.wrist") != std::string::npos);
    return made.error().message();
  };
  CHECK(refused({}).find("state.arm") != std::string::npos);
  CHECK(refused({kLines[0], kLines[2]}).find("observation/image") != std::string::npos);
  refused({kLines[0], kLines[1], kLines[2], "other=image"});  // one view, two keys
  refused({"observation/image=nothing"});
  refused({"observation/image"});
  refused({"observation/image=image,grey"});
  refused({"observation/image=image,degrees"});
  refused({"observation/state=arm,bgr"});
  refused({"actions=0:9,degrees"});
  refused({"actions=1:1,flipped"});
  refused({}, "humanoid");
  CHECK(refused({}, "libero").find("8 values") == std::string::npos);  // its state is called otherwise
}

TEST_CASE("an observation with a key that stands for nothing is refused, unless a line lets it pass") {
  const std::string message = seed_of("openpi/act");
  const auto refused = read_act(message, names({kLines[0], kLines[2], "camera=wrist"}));
  REQUIRE_FALSE(refused.ok());
  CHECK(refused.error().found == "observation/wrist_image");
  CHECK(refused.error().expected.find("camera") != std::string::npos);
  const auto passed = read_act(message, names({kLines[0], kLines[2], "camera=wrist", "observation/wrist_image="}));
  REQUIRE_MESSAGE(passed.ok(), (passed ? "" : passed.error().message()));
  CHECK(passed->views.size() == 1);
}

TEST_CASE("an array is written as the clients' packages write it") {
  const std::vector<std::size_t> shape{1, 2};
  const std::vector<float> values{1.5f, -2.0f};
  const std::string data("\0\0\xc0?\0\0\0\xc0", 8);
  CHECK(Writer().array(Framing::numpy, shape, values).take() ==
        std::string("\x85\xc4\x02nd\xc3\xc4\x04type\xa3<f4\xc4\x04kind\xc4\x00\xc4\x05shape\x92\x01\x02\xc4\x04"
                    "data\xc4\x08",
                    42) +
            data);
  CHECK(Writer().array(Framing::openpi, shape, values).take() ==
        std::string("\x84\xc4\x0b__ndarray__\xc3\xc4\x04"
                    "data\xc4\x08",
                    23) +
            data +
            std::string("\xc4\x05"
                        "dtype\xa3<f4\xc4\x05shape\x92\x01\x02",
                        21));
  const std::string npy = Writer().array(Framing::npy, shape, values).take();
  CHECK(
      npy.starts_with(std::string("\x82\xb1__ndarray_class__\xc3\xa6"
                                  "as_npy\xc4\x88\x93NUMPY\x01\0",
                                  37)));
  CHECK(npy.ends_with("\n" + data));
}

}  // namespace message_test
