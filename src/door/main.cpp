// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// vla-door-lerobot speaks LeRobot's asynchronous inference in a process of its own, which `vla serve --lerobot` starts.
// It parses HTTP/2 and pickles from strangers, so it holds nothing but their connections and a socket to the server.
#include <fmt/format.h>
#include <malloc.h>
#include <sys/eventfd.h>

#include <charconv>
#include <cstdio>
#include <exception>

#include "door/rpcs.h"
#include "door/sandbox.h"
#include "net/sweeper.h"
#include "serve/door/link.h"
#include "serve/lerobot/robots.h"

namespace vla::door {
namespace {

using serve::Link;
using serve::LinkMessage;
using serve::lerobot::Peer;
using serve::lerobot::Robots;
using Kind = LinkMessage::Kind;

constexpr int kLink = 3, kListener = 4, kFirstOther = 5;
constexpr std::size_t kReceiptMessages = 4;  // same value as for the other front ends, serve/options.h
constexpr std::size_t kOwnMemory = 128u << 20;
constexpr std::size_t kMaxKept = 1 << 20;  // largest message from the server: a response or a description
constexpr auto kLastWords = std::chrono::milliseconds(500);

struct Arguments {
  std::size_t max_message = 0, max_connections = 0;
  int parent = 0;
};

class Door final : Link::Handler, Robots::Server {
 public:
  Door(net::Loop& loop, const Arguments& given)
      : loop_(loop),
        link_(loop.context(), kLink, given.max_message + kMaxKept),
        rpcs_(loop, kListener,
              {given.max_message, given.max_connections, kReceiptMessages * (given.max_message + Rpcs::kMaxPiece)}),
        robots_([] { return Clock::now(); },
                {kReceiptMessages * given.max_message, given.max_message, given.max_connections}, rpcs_, *this),
        most_queued_(kReceiptMessages * given.max_message) {}
  ~Door() override { rpcs_.end(); }

  void start() {
    link_.start(*this);
    link_.send(Kind::ready);
  }
  /// Runs before every turn of the event loop.
  void begin() {
    if (!has_policy_ || is_over_) return;
    rpcs_.begin(robots_);
    sweeper_.turn([this] {
      robots_.sweep();
      ::malloc_trim(0);  // return the memory that a flood took to the system
    });
  }
  bool is_over() const { return is_over_; }
  bool has_answers() const { return rpcs_.has_answers(); }

 private:
  void came(LinkMessage message) override {
    const std::span<const std::byte> bytes = message.bytes.span();
    const std::string_view text(reinterpret_cast<const char*>(bytes.data()), bytes.size());
    switch (message.kind) {
      case Kind::ping:
        return link_.send(Kind::pong);
      case Kind::policy:
        return serve(message.text, text);
      case Kind::keep:
        return robots_.restore(message.text, text);
      case Kind::response:
        return robots_.answered(message.connection, bytes);
      default:
        return;
    }
  }
  /// The server has ended or is ending.
  void broke(const std::string&) override {
    is_over_ = true;
    robots_.stop();
    rpcs_.stop();
  }
  void serve(const std::string& map, std::string_view bytes) {
    v1::Description description;
    if (!description.ParseFromArray(bytes.data(), static_cast<int>(bytes.size()))) return broke("");
    auto names = serve::lerobot::lerobot_names(serve::given_of(map), description);
    if (!names) return broke("");  // the server has checked these lines
    robots_.serve(std::move(*names), description);
    has_policy_ = true;
  }

  void opened(const Peer& peer) override { link_.send(Kind::opened, peer.connection, peer.address); }
  void closed(const Peer& peer, const std::string& why, const std::string& detail) override {
    link_.send(Kind::closed, peer.connection, why.empty() ? "" : why + " " + detail);
  }
  bool ask(std::uint64_t connection, const std::string& request) override {
    if (link_.n_queued() > most_queued_) return false;
    link_.send(Kind::request, connection, {}, request);
    return true;
  }
  void refused(std::uint64_t connection) override { link_.send(Kind::refused, connection); }
  void keep(const std::string& address, const std::string& bytes) override {
    link_.send(Kind::keep, 0, address, bytes);
  }

  net::Loop& loop_;
  Link link_;
  Rpcs rpcs_;
  Robots robots_;
  net::Sweeper sweeper_{loop_};
  const std::size_t most_queued_;
  bool has_policy_ = false, is_over_ = false;
};

bool read(const char* text, auto& to) {
  const char* const end = text + std::char_traits<char>::length(text);
  const auto [at, failed] = std::from_chars(text, end, to);
  return failed == std::errc() && at == end;
}

int run(const Arguments& given) {
  // Descriptors: one per connection, those of the event loop, and the two inherited ones.
  confine({kOwnMemory + 16 * given.max_message, given.max_connections + 32}, given.parent, kFirstOther);
  net::Loop loop;
  const int never = ::eventfd(0, EFD_CLOEXEC);
  Door door(loop, given);
  loop.wait([] {}, never, loop.now());  // opens its descriptors before the sandbox forbids it
  if (const std::string missing = confine_calls(); !missing.empty())
    std::fprintf(stderr, "vla-door-lerobot: %s\n", missing.c_str());
  door.start();
  while (!door.is_over()) loop.wait([&] { door.begin(); }, never, std::nullopt);
  const auto end = loop.now() + kLastWords;
  while (door.has_answers() && loop.now() < end) loop.wait([] {}, never, end);
  return 0;
}

}  // namespace
}  // namespace vla::door

int main(int argc, char** argv) {
  vla::door::Arguments given;
  if (argc != 4 || !vla::door::read(argv[1], given.max_message) || !vla::door::read(argv[2], given.max_connections) ||
      !vla::door::read(argv[3], given.parent)) {
    std::fputs("vla-door-lerobot is started by vla serve --lerobot\n", stderr);
    return 2;
  }
  try {
    return vla::door::run(given);
  } catch (const std::exception& exception) {
    std::fprintf(stderr, "vla-door-lerobot: %s\n", exception.what());
    return 1;
  }
}
