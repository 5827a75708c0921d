// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// How long the server waits for its peers, by a clock of the test.
#include <doctest/doctest.h>
#include <fmt/format.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include <boost/asio/io_context.hpp>
#include <boost/asio/ip/tcp.hpp>
#include <boost/asio/write.hpp>
#include <list>

#include "zmtp/hub.h"

namespace patience_test {

using namespace vla;
using boost::asio::ip::tcp;

namespace {

Clock::time_point present;
Clock::time_point now_of_test() { return present; }

/// A hub with peers of this thread.
class Peers : zmtp::Hub::Handler {
 public:
  Peers() {
    const auto bound = hub_.bind("tcp://127.0.0.1:0");
    REQUIRE(bound);
    port_ = static_cast<std::uint16_t>(std::stoi(bound->substr(bound->rfind(':') + 1)));
  }
  ~Peers() { ::close(never_); }

  /// The n-th peer, n from 1, which sends this first.
  tcp::socket& connect(std::string_view first) {
    tcp::socket& socket = sockets_.emplace_back(context_);
    socket.connect({boost::asio::ip::make_address("127.0.0.1"), port_});
    boost::asio::write(socket, boost::asio::buffer(first));
    turn();
    return socket;
  }
  /// Until everything that was sent has come.
  void turn() {
    for (int n = 0; n < 20; ++n)
      loop_.wait([this] { hub_.begin(*this); }, never_, present + std::chrono::milliseconds(1));
  }
  void second_passes() {
    present += std::chrono::seconds(1);
    turn();
  }

  std::vector<std::string> dropped_peers;  // `N why`
  std::vector<std::string> messages;

 private:
  void received(zmtp::Client&, zmtp::Message message) override {
    const auto bytes = message.bytes.span();
    messages.emplace_back(reinterpret_cast<const char*>(bytes.data()), bytes.size());
  }
  void dropped(const zmtp::Client& client, const std::string& why, const std::string&) override {
    dropped_peers.push_back(fmt::format("{} {}", client.connection, why));
  }

  net::Loop loop_{now_of_test};
  zmtp::Hub hub_{loop_, {.message = 1 << 20, .connections = 64, .receipt = 4 << 20}, nullptr};
  std::uint16_t port_ = 0;
  const int never_ = eventfd(0, EFD_NONBLOCK);
  boost::asio::io_context context_;
  std::list<tcp::socket> sockets_;
};

const std::string kGreeting = std::string("\xff\0\0\0\0\0\0\0\1\x7f\3\0NULL", 16) + std::string(48, '\0');
const std::string kReady = std::string("\4\x1c\5READY\13Socket-Type\0\0\0\6DEALER", 30);

}  // namespace

TEST_CASE("a request that takes longer than the patience is received, and peers that fall silent are dropped") {
  Peers peers;
  peers.connect("");
  peers.connect(kGreeting);
  peers.connect(kGreeting + kReady);
  tcp::socket& slow = peers.connect(kGreeting + kReady);
  const std::string message = std::string("\0\x1e", 2) + std::string(30, 'm');
  for (int second = 0; second < 32; ++second) {
    CHECK(peers.messages.empty());
    boost::asio::write(slow, boost::asio::buffer(message.substr(static_cast<std::size_t>(second), 1)));
    peers.second_passes();
    CHECK(peers.dropped_peers.size() == (second < 10 ? 0 : second < 15 ? 2 : 3));
  }
  CHECK(peers.dropped_peers == std::vector<std::string>{"1 handshake", "2 handshake", "3 silent"});
  CHECK(peers.messages == std::vector<std::string>{std::string(30, 'm')});
}

TEST_CASE("a machine that stood still drops nobody") {
  Peers peers;
  peers.connect("");
  peers.connect(kGreeting + kReady);
  present += std::chrono::hours(1);
  peers.turn();
  CHECK(peers.dropped_peers.empty());
}

}  // namespace patience_test
