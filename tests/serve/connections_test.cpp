// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// The connections that gRPC serves, without gRPC.
#include "serve/lerobot/connections.h"

#include <doctest/doctest.h>
#include <fcntl.h>
#include <fmt/format.h>
#include <unistd.h>

#include <boost/asio/io_context.hpp>
#include <boost/asio/ip/tcp.hpp>
#include <list>

using namespace vla;
using namespace vla::serve::lerobot;
using boost::asio::ip::tcp;

namespace {

constexpr std::size_t kMiB = 1 << 20;

/// Connections of which nobody but the tests makes calls.
class Door : Connections::Handler {
 public:
  explicit Door(std::size_t n_connection = 64) : connections(loop, {kMiB, n_connection, 4 * kMiB}) {
    const auto bound = connections.bind("127.0.0.1:0", "--lerobot", false);
    REQUIRE(bound);
    port_ = static_cast<std::uint16_t>(std::stoi(bound->substr(bound->rfind(':') + 1)));
  }
  ~Door() override {
    for (const int descriptor : descriptors_) ::close(descriptor);
  }

  /// A peer from that address. What gRPC calls it.
  std::string connect(const std::string& address) {
    tcp::socket& socket = peers_.emplace_back(context_);
    socket.open(tcp::v4());
    socket.bind({boost::asio::ip::make_address(address), 0});
    socket.connect({boost::asio::ip::make_address("127.0.0.1"), port_});
    for (const std::size_t n = descriptors_.size(); descriptors_.size() == n;) turn();
    return fmt::format("ipv4:{}:{}", address, socket.local_endpoint().port());
  }
  /// Until everything that is to be told was told.
  void turn() {
    for (int n = 0; n < 20; ++n)
      loop.wait([this] { connections.begin(*this); }, pipe_, Clock::now() + std::chrono::milliseconds(1));
  }
  /// What gRPC does where the peer goes, or where its descriptor tells of the end.
  void close(std::size_t n) {
    ::shutdown(descriptors_[n], SHUT_RDWR);
    ::close(std::exchange(descriptors_[n], -1));
    turn();
  }
  bool is_open(std::size_t n) const {
    char byte;
    return ::recv(descriptors_[n], &byte, 1, MSG_PEEK | MSG_DONTWAIT) < 0;
  }

  net::Loop loop;
  Connections connections;
  std::vector<std::string> told;

 private:
  void came(int descriptor) override { descriptors_.push_back(descriptor); }
  void ended(const Peer& peer, const std::string& why, const std::string&) override {
    told.push_back(peer.address + " " + why);
  }

  std::uint16_t port_ = 0;
  const int pipe_ = ::open("/dev/null", O_RDONLY);
  boost::asio::io_context context_;
  std::list<tcp::socket> peers_;
  std::vector<int> descriptors_;
};

}  // namespace

TEST_CASE("where requests in receipt hold too much, a connection of the address that holds most ends") {
  Door door;
  const auto robot = door.connections.call_begins(door.connect("127.0.0.1"), 0);
  REQUIRE(robot);
  door.connections.receives(robot->connection, kMiB);
  std::vector<std::uint64_t> others;
  for (int i = 0; i < 6; ++i) {
    const auto other = door.connections.call_begins(door.connect("127.0.0.2"), 0);
    REQUIRE(other);
    CHECK(other->address == "127.0.0.2");
    others.push_back(other->connection);
    door.connections.receives(other->connection, kMiB / 2);
  }
  door.turn();
  CHECK(door.told.empty());  // 4 MiB
  door.connections.receives(others.back(), 1);
  door.turn();
  CHECK(door.told == std::vector<std::string>{"127.0.0.2 receipt"});
  CHECK(door.is_open(0));
  CHECK_FALSE(door.is_open(1));  // whose request began first

  door.connections.received(robot->connection, kMiB, true);  // room again
  door.connections.receives(others.back(), kMiB);
  door.turn();
  CHECK(door.told.size() == 1);
}

TEST_CASE("where there are too many calls, those of the address that has most end") {
  Door door(32);
  const std::string robot = door.connect("127.0.0.1");
  REQUIRE(door.connections.call_begins(robot, 0));
  const std::string first = door.connect("127.0.0.2"), second = door.connect("127.0.0.2");
  for (int i = 0; i < 16; ++i) REQUIRE(door.connections.call_begins(first, 0));
  for (int i = 0; i < 15; ++i) REQUIRE(door.connections.call_begins(second, 0));
  REQUIRE(door.connections.call_begins(robot, 0));
  door.turn();
  CHECK(door.told == std::vector<std::string>{"127.0.0.2 calls"});
  CHECK_FALSE(door.connections.call_begins(first, 0));
  for (int i = 0; i < 14; ++i) CHECK(door.connections.call_begins(robot, 0));
}

TEST_CASE("what gRPC may hold of a call that is not whole counts as received") {
  Door door;
  const std::string robot = door.connect("127.0.0.1"), other = door.connect("127.0.0.2");
  const auto call = door.connections.call_begins(robot, kMiB);
  for (int i = 0; i < 3; ++i) REQUIRE(door.connections.call_begins(other, kMiB));
  CHECK_FALSE(door.connections.call_begins(other, kMiB));
  door.turn();
  CHECK(door.told == std::vector<std::string>{"127.0.0.2 receipt"});
  REQUIRE(call);
  door.connections.received(call->connection, kMiB, true);
  for (int i = 0; i < 4; ++i) CHECK(door.connections.call_begins(robot, kMiB));
}

TEST_CASE("calls and bytes of a connection that ended, or of a call that did, do not count") {
  Door door(32);
  const std::string robot = door.connect("127.0.0.1");
  for (std::size_t n = 1; n < 20; ++n) {
    const std::string name = door.connect("127.0.0.2");
    for (int i = 0; i < 16; ++i) REQUIRE(door.connections.call_begins(name, 0));
    const auto call = door.connections.call_begins(robot, 0);
    REQUIRE(call);
    door.connections.receives(call->connection, kMiB);
    door.connections.received(call->connection, kMiB, false);
    door.connections.call_ends(call->connection);
    door.close(n);
    CHECK_FALSE(door.connections.call_begins(name, 0));
    CHECK(door.told == std::vector<std::string>(n, "127.0.0.2 "));
  }
}

TEST_CASE("where there are too many connections, one that did not call gives way to those that come") {
  Door door(8);
  const std::string robot = door.connect("127.0.0.1");
  const auto call = door.connections.call_begins(robot, 0);
  REQUIRE(call);
  door.connections.received(call->connection, 0, true);
  for (int i = 0; i < 30; ++i) door.connect("127.0.0.2");
  CHECK(door.told.size() >= 23);
  CHECK(std::all_of(door.told.begin(), door.told.end(), [](const auto& t) { return t == "127.0.0.2 connections"; }));
  CHECK(door.connections.call_begins(robot, 0));
}

TEST_CASE("names of peers that are none, or of nobody, are nobody's") {
  Door door;
  const std::string robot = door.connect("127.0.0.1");
  for (const std::string& name : {std::string(), std::string("ipv4:"), std::string("unix:here"), robot + "0",
                                  std::string("ipv6:%5B::1%5D:1"), std::string("ipv4:127.0.0.1:x")})
    CHECK_MESSAGE(!door.connections.call_begins(name, 0), name);
  CHECK(door.connections.call_begins("ipv6:%5B::ffff:127.0.0.1%5D" + robot.substr(robot.rfind(':')), 0));
}
