// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <filesystem>
#include <map>

#include "fuzz/lerobot_target.h"
#include "serve/support.h"
#include "support/editable_bundle.h"

namespace lerobot_test {

using namespace vla;
using namespace vla::serve;

namespace {

std::string seed(const std::string& name) {
  return test::read_text(test::source_path("tests/fuzz/regressions/lerobot/" + name));
}

const v1::Description& policy() {
  static const v1::Description description = fuzz::small_policy();
  return description;
}
const Names& names() {
  static const Names all = *lerobot::lerobot_names({}, policy());
  return all;
}
lerobot::Setup setup() {
  const std::string bytes = seed("setup");
  auto read = lerobot::read_setup(std::as_bytes(std::span(bytes)), names(), policy());
  REQUIRE(read);
  return *read;
}

}  // namespace

TEST_CASE("a set-up names the motors in the state's order and the cameras") {
  const lerobot::Setup known = setup();
  CHECK(known.motors == std::vector<std::string>{"arm.0", "arm.1", "hand"});
  REQUIRE(known.cameras.size() == 2);
  CHECK(known.cameras[0].key == "image");
  CHECK(known.cameras[0].entry->feature == "observation.images.image");
  CHECK(known.n_action == 50);
}

TEST_CASE("observations of every protocol of pickle and of both modules are the same act") {
  const lerobot::Setup known = setup();
  for (const char* name : {"observation", "observation_p5", "observation_old"}) {
    CAPTURE(name);
    const std::string bytes = seed(name);
    const auto message = pickle::Pickle::read(std::as_bytes(std::span(bytes)));
    REQUIRE(message);
    const auto observed = lerobot::read_observation(*message, known);
    REQUIRE(observed);
    CHECK(observed->timestep == 3);
    CHECK(observed->must_go);
    CHECK(observed->state == std::vector<float>{1.5f, 2.5f, -1});
    const auto act = lerobot::act_of(*message, *observed, known, names(), fuzz::small_limits());
    REQUIRE(act);
    const Observation observation = fuzz::served(*act);
    CHECK(observation.text == "go");
    CHECK(observation.states.at("state.arm") == std::vector<float>{1.5f, 2.5f, -1});
    const Frame& frame = *observation.views.at("observation.images.image");
    CHECK(frame.width == 4);
    CHECK(std::get<std::vector<std::uint8_t>>(frame.rgb)[47] == 47);
  }
}

TEST_CASE("a pickle that would execute is refused with the name") {
  const std::string bytes = seed("bomb");
  const auto read = pickle::Pickle::read(std::as_bytes(std::span(bytes)));
  REQUIRE(!read);
  CHECK(read.error().code == Code::bad_request);
  CHECK(read.error().found.find("pathlib") != std::string::npos);
}

TEST_CASE("a number in half precision is read as it is") {
  const std::string bytes = seed("half");
  const auto read = pickle::Pickle::read(std::as_bytes(std::span(bytes)));
  REQUIRE(read);
  CHECK(read->root().find("arm.0")->real == 0.5);
}

TEST_CASE("what fuzzing starts from is an act or refused") {
  std::map<std::string, bool> is_act;
  for (const auto& file : std::filesystem::directory_iterator(test::source_path("tests/fuzz/regressions/lerobot"))) {
    const std::string bytes = test::read_text(file.path());
    is_act[file.path().filename()] = fuzz::check_lerobot(std::as_bytes(std::span(bytes)));
  }
  for (const char* name : {"observation", "frame_f2", "frame_f4", "frame_f4_big", "frame_f8"})
    CHECK_MESSAGE(is_act[name], name);
  for (const char* name : {"frame_i8", "frame_fortran", "bomb"}) CHECK_MESSAGE(!is_act[name], name);
}

TEST_CASE("opcodes that do anything but make data, and what is beyond the bounds, are refused") {
  const std::string many(70000, 'N'), deep(100, '(');
  const std::string texts = "X" + std::string("\0\0\x10\0", 4) + std::string(1 << 20, 'x');  // of the longest one
  const std::string two = "(" + texts + texts + "l.", three = "(" + texts + texts + texts + "l.";
  CHECK(pickle::Pickle::read(std::as_bytes(std::span(two))).ok());
  for (const std::string& bytes :
       {std::string("\x80\x04"), std::string("Pabc\n."), std::string("Nb."), std::string("]a."), std::string("(."),
        std::string("h\x05."), std::string("X\xff\xff\xff\xff."), std::string("NN."), std::string("N.N"), many, deep,
        three, std::string("X\x01\x00\x00\x00\xff.", 7), std::string("\x8a\x09")}) {
    const auto read = pickle::Pickle::read(std::as_bytes(std::span(bytes)));
    REQUIRE(!read);
    CHECK(read.error().code == Code::bad_request);
  }
}

TEST_CASE("what is computed follows the reference's rules") {
  lerobot::Observed first;
  first.timestep = 3, first.state = {1.5f, 2.5f, -1};
  first.must_go = false;
  lerobot::Filter filter;
  CHECK(filter.takes(first));  // the first one
  filter.computes(first);
  lerobot::Observed next;
  next.timestep = first.timestep, next.state = first.state;
  CHECK(!filter.takes(next));  // its timestep has a chunk
  next.timestep = 4;
  next.state[0] += 0.99f;
  CHECK(!filter.takes(next));  // its state is near
  next.state[0] += 0.02f;
  CHECK(filter.takes(next));
  next.timestep = 3;
  CHECK(!filter.takes(next));
  filter.begin();
  CHECK(filter.takes(next));
  first.must_go = true;
  CHECK(filter.takes(first));
}

}  // namespace lerobot_test
