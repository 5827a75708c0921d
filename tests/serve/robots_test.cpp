// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// LeRobot's robots that lose their connection: each gets its own set-up back, or words that say what to do.
#include "serve/lerobot/robots.h"

#include <doctest/doctest.h>
#include <fmt/format.h>

#include "fuzz/lerobot_target.h"
#include "serve/lerobot/async_inference.pb.h"
#include "support/editable_bundle.h"
#include "support/pickled.h"

namespace robots_test {

using namespace vla;
using namespace vla::serve;
using namespace vla::serve::lerobot;

namespace {

const std::string kRobot = "10.0.0.1", kOther = "10.0.0.2";

/// A pickled RemotePolicyConfig of one camera and these motors.
std::string setup_of_motors(const std::vector<std::string>& motors) {
  pickle::Writer out;
  out.name("lerobot.async_inference.helpers", "RemotePolicyConfig").op(')').op('\x81').op('}').op('(');
  out.text("actions_per_chunk").integer(50).text("lerobot_features").op('}').op('(');
  out.text("observation.images.image").op('}').text("observation.state").op('}').text("names").op(']').op('(');
  for (const std::string& motor : motors) out.text(motor);
  transport::PolicySetup setup;
  setup.set_data(out.op('e').op('s').op('u').op('u').op('b').take());
  return setup.SerializeAsString();
}

/// The process of the front end without its sockets.
class Door : Calls, Robots::Server {
 public:
  explicit Door(std::size_t n_address = 8)
      : robots([] { return Clock::now(); }, {1 << 20, 1 << 20, n_address}, *this, *this) {
    v1::Description description = fuzz::small_policy();
    *description.mutable_limits() = fuzz::small_limits();
    description.mutable_views(1)->set_optional(true);
    robots.serve(*lerobot_names({"", {"observation.state=arm,in_order"}, {"wrist"}}, description), description);
  }

  std::uint64_t connect(const std::string& address) {
    const std::uint64_t connection = ++n_connection_;
    peers_[connection] = {connection, address, {}};
    return connection;
  }
  /// Ends the call with what `answer` or `refuse` got; "?" while it waits.
  std::string call(std::uint64_t connection, const std::string& method, const std::string& message = {}) {
    words = "?";
    robots.called({++n_call_, peers_.at(connection), method, message});
    return words;
  }
  void set_up(std::uint64_t connection, const std::vector<std::string>& motors) {
    CHECK(call(connection, "Ready") == "");
    REQUIRE(call(connection, "SendPolicyInstructions", setup_of_motors(motors)) == "");
  }
  /// An observation and the request for actions. The state that the server got, or how the robot was refused.
  std::string act(std::uint64_t connection) {
    asked.clear();
    const std::string refused =
        call(connection, "SendObservations", test::pickled_observation({"u1", "|", {1, 1, 3}, std::string(3, '\1')}));
    if (!refused.empty()) return refused;
    call(connection, "GetActions");
    v1::Request request;
    REQUIRE(request.ParseFromString(asked));
    std::string state;
    for (const float x : request.act().states(0).values()) state += std::to_string(static_cast<int>(x));
    return state;
  }
  void close(std::uint64_t connection) { robots.closed(peers_.at(connection), "", ""); }

  Robots robots;
  std::string words, asked;
  std::map<std::string, std::string> kept;

 private:
  void answer(std::uint64_t, const std::string& message) override { words = message; }
  void refuse(std::uint64_t, const Error& error) noexcept override {
    words = fmt::format("{}: {}", code_name(error.code), error.message());
  }
  void opened(const serve::lerobot::Peer&) override {}
  void closed(const serve::lerobot::Peer&, const std::string&, const std::string&) override {}
  bool ask(std::uint64_t, const std::string& request) override { return asked = request, true; }
  void refused(std::uint64_t) override {}
  void keep(const std::string& address, const std::string& bytes) override {
    if (bytes.empty()) {
      kept.erase(address);
    } else {
      kept[address] = bytes;
    }
  }

  std::map<std::uint64_t, serve::lerobot::Peer> peers_;
  std::uint64_t n_connection_ = 0, n_call_ = 0;
};

const std::vector<std::string> kMotors = {"arm.0", "arm.1", "hand"}, kReversed = {"hand", "arm.1", "arm.0"};

bool says_what_to_do(const std::string& words) {
  return words.starts_with("incompatible: ") && words.find("start the robot's client again") != std::string::npos;
}

}  // namespace

TEST_CASE("a robot that comes back on another connection gets its set-up") {
  Door door;
  const auto first = door.connect(kRobot);
  door.set_up(first, kMotors);
  CHECK(door.act(first) == "123");
  door.close(first);
  CHECK(door.act(door.connect(kRobot)) == "123");
  CHECK(says_what_to_do(door.act(door.connect(kOther))));
}

TEST_CASE("while a robot's connection has not ended, another of its address gets nothing of it") {
  Door door;
  const auto first = door.connect(kRobot);
  door.set_up(first, kMotors);
  CHECK(says_what_to_do(door.act(door.connect(kRobot))));
  door.close(first);
  CHECK(door.act(door.connect(kRobot)) == "123");
}

TEST_CASE("a monitor without a set-up takes nothing from a robot, whenever it asks") {
  Door door;
  const auto monitor = door.connect(kRobot);
  CHECK(says_what_to_do(door.call(monitor, "GetActions")));
  const auto first = door.connect(kRobot);
  door.set_up(first, kMotors);
  CHECK(door.call(monitor, "Ready") == "");
  door.close(first);
  CHECK(door.call(monitor, "Ready") == "");
  CHECK(door.act(door.connect(kRobot)) == "123");
  door.close(monitor);
  CHECK(door.act(door.connect(kRobot)) == "123");
}

TEST_CASE("two robots behind an address that come back crosswise get no other's joints") {
  Door door;
  const auto a = door.connect(kRobot), b = door.connect(kRobot);
  door.set_up(a, kMotors), door.set_up(b, kReversed);
  CHECK(door.act(a) == "123");
  CHECK(door.act(b) == "321");
  SUBCASE("both have ended") { door.close(a), door.close(b); }
  SUBCASE("one of them has ended, and the other's end is not seen yet") { door.close(a); }
  SUBCASE("in the other order") { door.close(b), door.close(a); }
  CHECK(says_what_to_do(door.act(door.connect(kRobot))));
  const auto again = door.connect(kRobot);
  door.set_up(again, kMotors);
  CHECK(door.act(again) == "123");
}

TEST_CASE("robots behind an address with one set-up all get it") {
  Door door;
  const auto a = door.connect(kRobot), b = door.connect(kRobot);
  door.set_up(a, kMotors), door.set_up(b, kMotors);
  door.close(a);
  CHECK(door.act(door.connect(kRobot)) == "123");
}

TEST_CASE("a process that is started again gives robots their set-ups, and remembers that there were two") {
  Door door;
  const auto a = door.connect(kRobot), b = door.connect(kOther), c = door.connect(kOther);
  door.set_up(a, kMotors), door.set_up(b, kMotors), door.set_up(c, kReversed);
  Door next;
  for (const auto& [address, bytes] : door.kept) next.robots.restore(address, bytes);
  CHECK(next.act(next.connect(kRobot)) == "123");
  CHECK(says_what_to_do(next.act(next.connect(kOther))));
  next.robots.restore("10.0.0.3", "o?");
  CHECK(says_what_to_do(next.act(next.connect("10.0.0.3"))));
}

TEST_CASE("addresses are forgotten before they are too many, those of the group that has most first") {
  Door door(8);
  const auto robot = door.connect(kRobot);
  door.set_up(robot, kMotors);
  door.close(robot);
  for (int i = 0; i < 100; ++i) {
    const auto other = door.connect(fmt::format("2001:db8::{:x}", i));
    door.set_up(other, kMotors);
    door.close(other);
  }
  CHECK(door.kept.size() == 8);
  CHECK(door.act(door.connect(kRobot)) == "123");
}

TEST_CASE("an answer reaches the call that waits for it, and a refusal is a refusal") {
  Door door;
  const auto robot = door.connect(kRobot);
  door.set_up(robot, kMotors);
  CHECK(door.act(robot) == "123");
  v1::Response response;
  response.set_request_id(1);
  response.mutable_chunk()->set_horizon(1);
  response.mutable_chunk()->set_d_action(3);
  for (int i = 0; i < 3; ++i) response.mutable_chunk()->add_actions(0.5f);
  const std::string chunk = response.SerializeAsString();
  door.robots.answered(robot, std::as_bytes(std::span(chunk)));
  CHECK(door.words.find("TimedAction") != std::string::npos);
  door.words = "?";
  door.robots.answered(robot, std::as_bytes(std::span(chunk)));  // nobody waits any more
  CHECK(door.words == "?");
  CHECK(door.act(robot) == "123");
  response.set_request_id(2);
  response.mutable_error()->set_code(v1::Error::BUSY);
  const std::string busy = response.SerializeAsString();
  door.robots.answered(robot, std::as_bytes(std::span(busy)));
  CHECK(door.words.starts_with("busy"));
}

}  // namespace robots_test
