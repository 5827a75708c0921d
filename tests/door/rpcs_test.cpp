// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "door/rpcs.h"

#include <arpa/inet.h>
#include <doctest/doctest.h>
#include <sys/eventfd.h>
#include <sys/socket.h>
#include <unistd.h>

#include "net/loop.h"

namespace rpcs_test {

using namespace vla;
using namespace std::chrono_literals;

namespace {

struct Count final : serve::lerobot::CallHandler {
  void called(serve::lerobot::Rpc) override {}
  void cancelled(std::uint64_t) override {}
  void opened(const serve::lerobot::Peer&) override { ++n_opened; }
  void closed(const serve::lerobot::Peer&, const std::string&, const std::string&) override {}
  int n_opened = 0;
};

/// A socket that listens on a free port, and that port.
int listening(sockaddr_in& at) {
  const int socket = ::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
  at.sin_family = AF_INET;
  at.sin_addr.s_addr = ::htonl(INADDR_LOOPBACK);
  socklen_t size = sizeof(at);
  REQUIRE(::bind(socket, reinterpret_cast<sockaddr*>(&at), size) == 0);
  REQUIRE(::listen(socket, 8) == 0);
  REQUIRE(::getsockname(socket, reinterpret_cast<sockaddr*>(&at), &size) == 0);
  return socket;
}

/// A client of its own descriptor, or -1.
int connect(const sockaddr_in& at) {
  const int client = ::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
  if (::connect(client, reinterpret_cast<const sockaddr*>(&at), sizeof(at)) == 0) return client;
  ::close(client);
  return -1;
}

}  // namespace

TEST_CASE("once stopped it takes no connection, while the loop goes on for answers under way") {
  sockaddr_in at = {};
  const int socket = listening(at), never = ::eventfd(0, EFD_CLOEXEC);
  Count count;
  net::Loop loop;
  door::Rpcs rpcs(loop, socket, {1 << 20, 8, 4 << 20});
  const auto wait = [&](Clock::duration time, const std::function<void()>& begin) {
    for (const auto end = loop.now() + time; loop.now() < end;) loop.wait(begin, never, end);
  };
  const int first = connect(at);
  wait(50ms, [&] { rpcs.begin(count); });
  CHECK(count.n_opened == 1);
  const int second = connect(at);  // in the queue of the socket
  rpcs.stop();
  wait(250ms, [&] { rpcs.begin(count); });  // longer than until a listener tries again
  CHECK(count.n_opened == 1);
  CHECK(connect(at) == -1);
  rpcs.end();
  for (const int open : {first, second, never}) ::close(open);
}

}  // namespace rpcs_test
