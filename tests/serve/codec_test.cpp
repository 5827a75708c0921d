// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/native/codec.h"

#include <doctest/doctest.h>
#include <fmt/format.h>

#include <cctype>

#include "support/editable_bundle.h"
#include "wire/envelope.h"

namespace codec_test {

using namespace vla;
using namespace vla::serve;
using namespace vla::wire;

namespace {

const ActLimits kLimits = {
    .max_pixels = 10'000, .max_text = 40, .max_views = 5, .horizon = 2, .noise_rows = 2, .d_noise = 3, .d_action = 2};
const FeatureNames kViews("view", {"observation.images.png"}, {""}), kStates("state", {"robot.arm"}, {""});

/// Every field of the schema, one alternative of each choice.
v1::Act full_act() {
  v1::Act act;
  v1::View& raw = *act.add_views();
  raw.set_name("raw");
  raw.mutable_rgb()->set_width(2);
  raw.mutable_rgb()->set_height(1);
  raw.mutable_rgb()->set_rows("\x01\x02\x03\x04\x05\x06");
  v1::View& jpeg = *act.add_views();
  jpeg.set_name("jpeg");
  jpeg.set_jpeg(test::read_text(test::source_path("tests/processor/data/images/rgb_444.jpg")));
  v1::View& png = *act.add_views();
  png.set_name("png");
  png.set_png(test::read_text(test::source_path("tests/processor/data/images/rgba.png")));
  v1::View& absent = *act.add_views();
  absent.set_name("absent");
  absent.mutable_absent();
  v1::State& state = *act.add_states();
  state.set_name("arm");
  state.add_values(0.5f);
  state.add_values(-1.5f);
  act.set_text("go");
  act.mutable_noise()->set_horizon(2);
  act.mutable_noise()->set_d_action(3);
  for (int i = 0; i < 6; ++i) act.mutable_noise()->add_values(static_cast<float>(i));
  act.set_capture_time_ns(-5);
  act.set_deadline_ms(7);
  v1::Leftover& leftover = *act.mutable_leftover();
  leftover.set_n_row(2);
  leftover.set_d_action(2);
  for (int i = 0; i < 4; ++i) leftover.add_values(static_cast<float>(i));
  leftover.set_delay(1);
  leftover.set_schedule("exp");
  leftover.set_max_guidance(2.5);
  act.mutable_loop()->set_driver(v1::LoopState::PERSON);
  act.mutable_loop()->set_actions(std::uint64_t{1} << 53);
  return act;
}

Result<ActRequest> decode(const std::string& bytes) {
  return decode_act(std::as_bytes(std::span(bytes)), kLimits, kViews, kStates);
}
Result<ActRequest> decode(const v1::Act& act) { return decode(act.SerializeAsString()); }

void check_refused(const v1::Act& act, Code code, const std::string& where) {
  const auto request = decode(act);
  REQUIRE_FALSE(request.ok());
  CHECK(std::string(code_name(request.error().code)) == std::string(code_name(code)));
  CHECK(request.error().where == where);
}

/// A field as it stands on the wire.
std::string varint_field(int number, std::uint8_t value) {
  return {static_cast<char>(number << 3), static_cast<char>(value)};
}
std::string bytes_field(int number, const std::string& value) {
  return std::string{static_cast<char>((number << 3) | 2), static_cast<char>(value.size())} + value;
}

Status envelope_of(const std::string& bytes, Envelope& envelope) {
  return read_envelope(std::as_bytes(std::span(bytes)), envelope);
}

}  // namespace

TEST_CASE("an act with every field of the schema becomes the observation that it states") {
  const auto request = decode(full_act());
  REQUIRE_MESSAGE(request.ok(), (request ? "" : request.error().message()));
  const Observation& observation = request->observation;
  CHECK(observation.text == "go");
  CHECK(observation.states.at("arm") == std::vector<float>{0.5f, -1.5f});
  CHECK(observation.views.size() == 4);
  CHECK_FALSE(observation.views.at("absent").has_value());
  CHECK(std::get<0>(observation.views.at("raw")->rgb) == std::vector<std::uint8_t>{1, 2, 3, 4, 5, 6});
  CHECK(observation.views.at("jpeg")->width > 1);
  CHECK(observation.views.at("png")->width > 1);
  CHECK(std::get<std::vector<float>>(request->noise) == std::vector<float>{0, 1, 2, 3, 4, 5});
  CHECK_FALSE(request->seed);
  CHECK(request->capture_time_ns == -5);
  REQUIRE(request->leftover.has_value());
  CHECK(request->leftover->rows == std::vector<float>{0, 1, 2, 3});
  CHECK(request->leftover->delay == 1);
  CHECK(request->leftover->schedule == "exp");
  CHECK(request->leftover->max_guidance == 2.5);
}

TEST_CASE("a leftover whose rows and columns do not make its numbers is refused before anything is read of it") {
  const auto refused = [](auto change) {
    v1::Act act = full_act();
    change(*act.mutable_leftover());
    check_refused(act, Code::bad_observation, "leftover");
  };
  refused([](v1::Leftover& l) { l.set_n_row(4), l.set_d_action(1); });
  refused([](v1::Leftover& l) { l.set_n_row(1); });
  refused([](v1::Leftover& l) { l.set_n_row(0xFFFFFFFF); });
  refused([](v1::Leftover& l) { l.set_delay(0x80000000); });
  refused([](v1::Leftover& l) { l.add_values(1.0f); });
  v1::Act act = full_act();
  act.mutable_leftover()->clear_schedule();
  act.mutable_leftover()->clear_max_guidance();
  CHECK_FALSE(decode(act)->leftover->max_guidance.has_value());
  act.clear_leftover();
  CHECK_FALSE(decode(act)->leftover.has_value());
}

TEST_CASE(
    "a loop's state without a driver, with a count that none can be or with a field of another version is refused") {
  v1::Act act = full_act();
  for (const int driver : {0, 3, -1}) {
    act.mutable_loop()->set_driver(static_cast<v1::LoopState::Driver>(driver));
    check_refused(act, driver < 0 ? Code::bad_request : Code::bad_observation, driver < 0 ? "act" : "loop.driver");
  }
  act = full_act();
  act.mutable_loop()->set_actions((std::uint64_t{1} << 53) + 1);
  check_refused(act, Code::bad_request, "act");
  act.clear_loop();
  CHECK(decode(act).ok());
  const std::string driver = varint_field(1, 1);
  CHECK(decode(act.SerializeAsString() + bytes_field(11, driver)).ok());
  for (const std::string& loop : {driver + varint_field(8, 1), driver + bytes_field(2, "1"), std::string("\x08")})
    CHECK(decode(act.SerializeAsString() + bytes_field(11, loop)).error().code == Code::bad_request);
}

TEST_CASE("a seed is taken as it is, also zero, and without one a fresh seed is drawn each time") {
  v1::Act act = full_act();
  act.set_seed(0);
  CHECK(decode(act)->seed == 0);
  act.clear_start();
  const auto first = decode(act), second = decode(act);
  REQUIRE(first->seed);
  CHECK(*first->seed != *second->seed);
  CHECK(std::get<std::uint64_t>(first->noise) == *first->seed);
}

TEST_CASE("what is over a limit is told apart from what is wrong") {
  v1::Act act = full_act();
  act.set_text(std::string(41, 'a'));
  check_refused(act, Code::too_large, "instruction");
  act = full_act();
  for (const char* name : {"e", "f"}) act.add_views()->set_name(name);
  check_refused(act, Code::too_large, "views");
  act = full_act();
  act.mutable_views(0)->mutable_rgb()->set_width(4'000'000'000u);
  act.mutable_views(0)->mutable_rgb()->set_height(4'000'000'000u);
  check_refused(act, Code::too_large, "view \"raw\"");
  act = full_act();
  act.mutable_views(1)->set_jpeg(test::read_text(test::source_path("tests/processor/data/images/bad_huge.jpg")));
  check_refused(act, Code::too_large, "view \"jpeg\"");
  act.mutable_views(1)->set_png(test::read_text(test::source_path("tests/processor/data/images/bad_huge.png")));
  check_refused(act, Code::too_large, "view \"jpeg\"");
}

TEST_CASE("text has its limit before its bytes are looked at") {
  const auto refused = [](const std::string& more, Code code, const std::string& where) {
    const auto request = decode(full_act().SerializeAsString() + more);
    REQUIRE_FALSE(request.ok());
    CHECK(request.error().code == code);
    CHECK(request.error().where == where);
  };
  const std::string odd(100, '\xff');  // no text
  refused(bytes_field(v1::Act::kTextFieldNumber, odd), Code::too_large, "instruction");
  refused(bytes_field(v1::Act::kTextFieldNumber, "\xff"), Code::bad_request, "act");
  refused(bytes_field(v1::Act::kEmbodimentFieldNumber, odd), Code::bad_request, "act");
}

TEST_CASE("images are counted together before any is decoded") {
  v1::Act act = full_act();
  act.mutable_views(0)->mutable_rgb()->set_width(99);
  act.mutable_views(0)->mutable_rgb()->set_height(100);  // its rows are not there, which nobody looks at
  act.mutable_views(1)->set_png(test::read_text(test::source_path("tests/processor/data/images/rgb.png")));
  check_refused(act, Code::too_large, "view \"jpeg\"");
}

TEST_CASE("a name that would make an error long is refused without being told back") {
  v1::Act act = full_act();
  act.mutable_views(0)->set_name(std::string(257, 'n'));
  check_refused(act, Code::too_large, "views");
  act = full_act();
  act.mutable_states(0)->set_name(std::string(257, 'n'));
  check_refused(act, Code::too_large, "states");
}

TEST_CASE("an error is text even where it tells of bytes that are none") {
  const v1::Error error = encode_error({Code::io, "a\xff\xfe", "", "\xc3"});
  CHECK(error.where() == "a??");
  CHECK(error.found() == "?");
}

TEST_CASE("a view is refused by name: no image, another format, other bytes than its size says, twice") {
  v1::Act act = full_act();
  act.mutable_views(0)->clear_image();
  check_refused(act, Code::bad_observation, "view \"raw\"");
  act = full_act();
  act.mutable_views(0)->mutable_rgb()->set_height(2);
  check_refused(act, Code::bad_observation, "view \"raw\"");
  act.mutable_views(0)->mutable_rgb()->set_height(0);
  check_refused(act, Code::bad_observation, "view \"raw\"");
  act = full_act();
  act.mutable_views(1)->set_png(full_act().views(1).jpeg());
  check_refused(act, Code::bad_observation, "view \"jpeg\"");
  act = full_act();
  act.mutable_views(2)->mutable_png()->resize(60);
  check_refused(act, Code::bad_observation, "observation.images.png");
  act = full_act();
  act.mutable_views(2)->set_png("");
  check_refused(act, Code::bad_observation, "observation.images.png");
  act = full_act();
  act.mutable_views(1)->set_name("raw");
  check_refused(act, Code::bad_observation, "view \"raw\"");
}

TEST_CASE("a state that is given twice and noise of another shape are refused") {
  v1::Act act = full_act();
  *act.add_states() = act.states(0);
  check_refused(act, Code::bad_observation, "robot.arm");
  act = full_act();
  act.mutable_noise()->set_horizon(3);
  act.mutable_noise()->set_d_action(2);
  check_refused(act, Code::bad_observation, "noise");
}

TEST_CASE("a field that this version does not know is refused in every message of an act, not skipped") {
  CHECK(decode(full_act().SerializeAsString() + varint_field(8, 1)).error().code == Code::bad_request);
  const std::string rgb = full_act().views(0).rgb().SerializeAsString() + varint_field(4, 1);
  const std::string noise = full_act().noise().SerializeAsString() + varint_field(4, 1);
  for (const std::string& act :
       {bytes_field(1, varint_field(6, 1)), bytes_field(1, bytes_field(2, rgb)), bytes_field(2, varint_field(3, 1)),
        bytes_field(1, bytes_field(5, varint_field(1, 1))), bytes_field(4, noise)})
    CHECK(decode(act).error().code == Code::bad_request);
}

TEST_CASE("a known field in another encoding is refused: Protobuf would skip it, and a seed would be drawn instead") {
  v1::Act act = full_act();
  act.clear_start();
  const std::string seed_as_bytes = bytes_field(v1::Act::kSeedFieldNumber, "1");
  CHECK(decode(act.SerializeAsString() + varint_field(v1::Act::kSeedFieldNumber, 9))->seed == 9);
  CHECK(decode(act.SerializeAsString() + seed_as_bytes).error().code == Code::bad_request);
}

TEST_CASE("numbers that are not packed are read too") {
  v1::Act act = full_act();
  act.clear_states();
  const std::string value{'\x15', '\0', '\0', '\0', '\x3f'};  // field 2, four bytes: 0.5
  const auto request = decode(act.SerializeAsString() + bytes_field(2, bytes_field(1, "s") + value + value));
  REQUIRE(request.ok());
  CHECK(request->observation.states.at("s") == std::vector<float>{0.5f, 0.5f});
}

TEST_CASE("more fields than any act has are refused before they are parsed") {
  std::string act;
  for (int i = 0; i < 20'000; ++i) act += bytes_field(1, "");
  CHECK(decode(act).error().expected == "at most 16384 fields");
}

TEST_CASE("text that is not UTF-8 is refused") {
  const std::string bytes = bytes_field(3, "\xff\xfe");
  CHECK(decode(bytes).error().code == Code::bad_request);
}

TEST_CASE("an act cut anywhere is refused or is a smaller sound act, and never crashes") {
  const std::string whole = full_act().SerializeAsString();
  for (std::size_t size = 0; size < whole.size(); ++size) (void)decode(whole.substr(0, size)).ok();
  CHECK(decode(whole).ok());
}

TEST_CASE("an envelope tells number, kind, body and deadline of a request without parsing its images") {
  v1::Request request;
  request.set_protocol_version(1);
  request.set_request_id(77);
  *request.mutable_act() = full_act();
  const std::string bytes = request.SerializeAsString();
  Envelope envelope;
  REQUIRE(envelope_of(bytes, envelope).ok());
  CHECK(envelope.request_id == 77);
  CHECK(envelope.kind == Kind::act);
  CHECK(envelope.deadline_ms == 7);
  CHECK(envelope.body_size == full_act().ByteSizeLong());
  CHECK(envelope.body_at + envelope.body_size == bytes.size());
}

TEST_CASE("an envelope of another version is refused with both versions, whatever else it holds, and with its number") {
  for (const std::uint8_t version : {0, 2, 99}) {
    Envelope envelope;
    const Status read = envelope_of(varint_field(9, 1) + varint_field(1, version) + varint_field(2, 5), envelope);
    REQUIRE_FALSE(read.ok());
    CHECK(read.error().code == Code::incompatible);
    CHECK(read.error().expected == "version 1");
    CHECK(read.error().found == "version " + std::to_string(version));
    CHECK(envelope.request_id == 5);
  }
}

TEST_CASE("an envelope with no kind, two kinds, an unknown field or broken bytes is refused") {
  const std::string version = varint_field(1, 1);
  for (const std::string& bytes :
       {version, version + bytes_field(4, "") + bytes_field(6, ""), version + bytes_field(4, "") + bytes_field(9, ""),
        varint_field(9, 1) + version + bytes_field(4, ""), version + std::string("\x22\x05\x01"),
        version + bytes_field(5, "\x38"), version + std::string("\x23"), std::string("\xff\xff\xff")}) {
    Envelope envelope;
    const Status read = envelope_of(bytes, envelope);
    REQUIRE_FALSE(read.ok());
    CHECK(read.error().code == Code::bad_request);
  }
}

TEST_CASE("which robot an act names is read before the rest of it") {
  const auto named = [](const std::string& bytes) { return named_embodiment(std::as_bytes(std::span(bytes))); };
  v1::Act act;
  act.set_text("go");
  CHECK(named(act.SerializeAsString())->empty());
  act.set_embodiment("arm");
  const std::string bytes = act.SerializeAsString();
  CHECK(*named(bytes) == "arm");
  v1::Act later;
  later.set_embodiment("dog");
  CHECK(*named(bytes + later.SerializeAsString()) == "dog");  // as Protobuf reads a field that comes twice
  CHECK(named(bytes.substr(0, bytes.size() - 1)).error().code == Code::bad_request);
  later.set_embodiment(std::string(100'000, 'x'));
  CHECK(named(later.SerializeAsString()).error().code == Code::too_large);
}

TEST_CASE("a hello is answered where a common version exists and refused with both ranges where there is none") {
  const auto answer = [](std::uint32_t min, std::uint32_t max) {
    v1::Hello hello;
    hello.set_min_version(min);
    hello.set_max_version(max);
    const std::string bytes = hello.SerializeAsString();
    return answer_hello(std::as_bytes(std::span(bytes)));
  };
  CHECK(answer(1, 1).ok());
  CHECK(answer(1, 9)->max_version() == 1);
  CHECK(answer(2, 9).error().code == Code::incompatible);
  CHECK(answer(2, 9).error().found == "versions 2 to 9");
  CHECK(answer(0, 1).error().code == Code::bad_request);
  CHECK(answer(3, 2).error().code == Code::bad_request);
}

TEST_CASE("codes on the wire are the exit codes of the program, in the same order and with the same names") {
  for (int i = 0; i < v1::Error::Code_ARRAYSIZE - 1; ++i) {
    const auto code = static_cast<Code>(i);
    const v1::Error error = encode_error({code, "where", "expected", "found", "hint"});
    CHECK(error.code() == exit_code(code));
    std::string name = v1::Error::Code_Name(error.code());
    for (char& c : name) c = static_cast<char>(std::tolower(c));
    CHECK(name == code_name(code));
  }
}

TEST_CASE("the exchange in docs/protocol.md is what the schema makes of it, byte for byte") {
  const std::string document = test::read_text(test::source_path("docs/protocol.md"));
  const auto check = [&](const auto& message) {
    std::string text;
    for (const char byte : message.SerializeAsString())
      text += fmt::format("{}{:02x}", text.empty() ? "" : " ", static_cast<unsigned char>(byte));
    CHECK(document.find("\n" + text + "\n") != std::string::npos);
  };
  v1::Request request;
  request.set_protocol_version(1);
  request.set_request_id(1);
  v1::Hello& hello = *request.mutable_hello();
  hello.set_min_version(1);
  hello.set_max_version(1);
  hello.set_client_name("example");
  check(request);
  v1::Response response = response_to(1);
  const std::string bytes = hello.SerializeAsString();
  *response.mutable_hello() = *answer_hello(std::as_bytes(std::span(bytes)));
  check(response);
  request.set_request_id(2);
  v1::Act& act = *request.mutable_act();
  v1::View& view = *act.add_views();
  view.set_name("top");
  view.mutable_rgb()->set_width(2);
  view.mutable_rgb()->set_height(1);
  view.mutable_rgb()->set_rows(std::string("\xff\0\0\0\0\xff", 6));
  act.add_states()->set_name("state");
  act.mutable_states(0)->add_values(0.5f);
  act.mutable_states(0)->add_values(-1.0f);
  act.set_text("go");
  act.set_seed(7);
  act.set_deadline_ms(200);
  check(request);
  response = response_to(2);
  *response.mutable_error() = encode_error({Code::bad_observation, "observation.state", "6 numbers", "2"});
  check(response);
}

}  // namespace codec_test
