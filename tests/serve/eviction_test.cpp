// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "net/eviction.h"

#include <arpa/inet.h>
#include <sys/socket.h>
#include <unistd.h>

#include "serve/support.h"
#include "zmtp/hub.h"

namespace eviction_test {

using namespace vla;
using namespace vla::net;
using vla::zmtp::Hub;
using namespace vla::test;

namespace {

constexpr std::size_t kMiB = 1 << 20;
const Clock::time_point kNow = Clock::time_point(std::chrono::hours(1));
Clock::time_point ago(int ms) { return kNow - std::chrono::milliseconds(ms); }

/// Answers every message with a megabyte.
struct Generous : Hub::Handler {
  Hub& hub;
  int n_received = 0;
  explicit Generous(Hub& its_hub) : hub(its_hub) {}
  void received(zmtp::Client& client, zmtp::Message) override {
    ++n_received;
    hub.send(client.connection, std::string(kMiB, 'a'), {});
  }
  void dropped(const zmtp::Client&, const std::string&, const std::string&) override {}
};

/// A connection to a server from an address of this machine that sends what it is told to, and does not read.
class Silent {
 public:
  Silent(std::uint32_t from, const std::string& server) : fd_(::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0)) {
    sockaddr_in own = {}, its = {};
    own.sin_family = its.sin_family = AF_INET;
    own.sin_addr.s_addr = htonl(from);
    its.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    its.sin_port = htons(static_cast<std::uint16_t>(std::stoi(server.substr(server.rfind(':') + 1))));
    REQUIRE(::bind(fd_, reinterpret_cast<const sockaddr*>(&own), sizeof(own)) == 0);
    REQUIRE(::connect(fd_, reinterpret_cast<const sockaddr*>(&its), sizeof(its)) == 0);
  }
  ~Silent() { ::close(fd_); }
  void send(const std::string& bytes) {
    REQUIRE(::send(fd_, bytes.data(), bytes.size(), MSG_NOSIGNAL) == static_cast<ssize_t>(bytes.size()));
  }
  Silent(const Silent&) = delete;
  Silent& operator=(const Silent&) = delete;

 private:
  int fd_;
};

}  // namespace

TEST_CASE("an IPv6 network of 64 bits is one group, and an address or a key is its own") {
  CHECK(group_of("127.0.0.1") != group_of("127.9.8.7"));
  CHECK(group_of("10.0.0.1") == group_of("::ffff:10.0.0.1"));
  CHECK(group_of("fd00:1:2:3::1") == group_of("fd00:1:2:3:ffff::2"));
  CHECK(group_of("fd00:1:2:3::1") != group_of("fd00:1:2:4::1"));
  CHECK(group_of("10.0.0.1") != group_of("10.0.0.2"));
  CHECK(group_of("ipc user 7") == "ipc user 7");
}

TEST_CASE("a connection that is served keeps its place, whatever its peer is called and however many others come") {
  for (const char* name : {"0", "zz"}) {
    Standings all = {{1, name, true, ago(500)}};
    for (std::uint64_t i = 2; i <= 9; ++i) all.push_back({i, "peer " + std::to_string(i), true, ago(1)});
    const auto chosen = to_evict(all, 8, kNow);
    REQUIRE(chosen);
    CHECK(*chosen != 1);
  }
}

TEST_CASE("handshakes are bounded on their own, and the oldest of the largest group gives way") {
  Standings all = {{1, "robot", true, ago(500)}, {2, "idle", true}, {3, "robot", false}};
  for (std::uint64_t i = 4; i <= 7; ++i) all.push_back({i, "flood", false});
  CHECK(to_evict(all, 16, kNow) == 4);
  all.erase(all.begin() + 3);
  CHECK_FALSE(to_evict(all, 16, kNow));
}

TEST_CASE(
    "eight connections of one robot do not give way to silent ones from many addresses, nor does a request on its "
    "way") {
  Standings all;
  for (std::uint64_t i = 0; i < 8; ++i) all.push_back({i, "robot", true, {}, {}, i == 0 ? 100U : 0U});
  for (std::uint64_t i = 8; i < 257; ++i) all.push_back({i, std::to_string(i), true});
  for (std::uint64_t i = 1; i < 8; ++i) all[i].served = ago(90'000);  // too long ago for a kept place
  CHECK(to_evict(all, 256, kNow) == 8);
  for (std::uint64_t i = 8; i < 26; ++i) all[i].group = "attacker";
  all[25].n_held = 1000;
  all[8].served = all[9].served = ago(80'000);
  CHECK(to_evict(all, 256, kNow) == 10);
}

TEST_CASE("where all are served, a new connection is let in and one that came late gives way") {
  Standings all;
  for (std::uint64_t i = 1; i <= 8; ++i) all.push_back({i, "peer " + std::to_string(i), true, ago(100)});
  all.push_back({9, "new", false});
  CHECK(to_evict(all, 8, kNow) == 5);
}

TEST_CASE("half-sent requests of many peers give way before a request of one that is served, or that is new") {
  for (const bool is_served : {false, true}) {
    Standings all = {{1, "robot", true, is_served ? ago(100) : Clock::time_point(), ago(1), 6 * kMiB}};
    for (std::uint64_t i = 2; i <= 201; ++i)
      all.push_back({i, "peer " + std::to_string(i), true, {}, ago(1000), kMiB * 2 / 3});
    const auto chosen = to_interrupt(all, 256, 32 * kMiB, 128 * kMiB, kNow);
    REQUIRE(chosen);
    CHECK(*chosen != 1);
    all.resize(150);
    CHECK_FALSE(to_interrupt(all, 256, 32 * kMiB, 128 * kMiB, kNow));
  }
}

TEST_CASE("a robot that is served stays connected while 300 addresses of its machine connect, and so do new clients") {
  Running running;
  Peer robot(running.address());
  CHECK(robot.ask(act_request(golden(), 1)).has_chunk());
  std::vector<std::unique_ptr<Silent>> flood;
  for (std::uint32_t i = 0; i < 300; ++i)
    flood.push_back(std::make_unique<Silent>(INADDR_LOOPBACK + 1 + i, running.address()));
  v1::Request health = request_of(2);
  health.mutable_health();
  robot.send(health);
  CHECK(robot.receive(3000).has_value());
  Peer late(running.address());
  late.send(health);
  CHECK(late.receive(3000).has_value());
}

TEST_CASE("a peer that reads no answers is not read from once they take 128 KiB, however few they are") {
  Loop loop;
  Hub hub(loop, {kMiB, 8, 4 * kMiB}, nullptr);
  Generous handler(hub);
  const auto address = hub.bind("tcp://127.0.0.1:0");
  REQUIRE(address);
  Silent peer(INADDR_LOOPBACK, *address);
  std::string bytes("\xff\0\0\0\0\0\0\0\1\x7f\3\1NULL", 16);
  bytes.resize(64);
  bytes += std::string(
      "\4\x1c\5READY\xbSocket-Type\0\0\0\6"
      "DEALER",
      30);
  for (int i = 0; i < 60; ++i) bytes += std::string("\0\1a", 3);
  peer.send(bytes);
  for (const auto end = Clock::now() + std::chrono::milliseconds(500); Clock::now() < end;)
    loop.wait([&] { hub.begin(handler); }, STDERR_FILENO, end);
  CHECK(handler.n_received > 0);
  CHECK(handler.n_received < 20);  // what the system's own buffers take, and one more
}

}  // namespace eviction_test
