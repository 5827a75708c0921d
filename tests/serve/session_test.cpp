// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// ZMTP byte by byte, without a socket.
#include "zmtp/session.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <cstring>
#include <random>

namespace session_test {

using namespace vla;
using namespace vla::zmtp;

namespace {

constexpr std::size_t kMaxMessage = 1000;

std::string greeting(const char* mechanism = "NULL") {
  std::string text = std::string("\xff\0\0\0\0\0\0\0\1\x7f\3\1", 12) + mechanism;
  text.resize(64);
  return text;
}

std::string frame(const std::string& content, char flags = 0) {
  std::string out(1, flags);
  if (content.size() < 256) return out + static_cast<char>(content.size()) + content;
  out[0] = static_cast<char>(flags | 2);
  for (int shift = 56; shift >= 0; shift -= 8) out += static_cast<char>(content.size() >> shift);
  return out + content;
}

std::string long_header(std::uint64_t size, char flags = 2) {
  std::string out(1, flags);
  for (int shift = 56; shift >= 0; shift -= 8) out += static_cast<char>(size >> shift);
  return out;
}

const std::string kReady = frame(std::string("\x05READY\x0bSocket-Type\0\0\0\x06"
                                             "DEALER",
                                             28),
                                 4);
const std::string kHandshake = greeting() + kReady;

struct Outcome {
  std::vector<Message> messages;
  std::optional<Error> ended;
};

/// Feeds bytes in pieces of at most `step`.
Outcome feed(Session& session, const std::string& bytes, std::size_t step = 1 << 20) {
  Outcome outcome;
  for (std::size_t at = 0; at < bytes.size();) {
    const std::span<std::byte> room = session.room();
    REQUIRE_FALSE(room.empty());
    const std::size_t n = std::min<std::size_t>({room.size(), step, bytes.size() - at});
    std::memcpy(room.data(), bytes.data() + at, n);
    session.filled(n);
    at += n;
    for (;;) {
      auto message = session.next();
      if (!message) {
        outcome.ended = message.error();
        return outcome;
      }
      if (!*message) break;
      outcome.messages.push_back(std::move(**message));
    }
  }
  return outcome;
}

std::string text_of(const Message& message) {
  return {reinterpret_cast<const char*>(message.bytes.span().data()), message.bytes.size()};
}

std::string why_ended(const std::string& bytes) {
  Session session(kMaxMessage, nullptr);
  const Outcome outcome = feed(session, bytes);
  return outcome.ended ? outcome.ended->where : "";
}

}  // namespace

TEST_CASE("messages come out the same however their bytes are cut") {
  const std::string bytes = kHandshake + frame("short") + frame("", 1) + frame(std::string(999, 'x')) + frame("");
  for (std::size_t step : {1, 2, 3, 7, 64, 100, 1 << 20}) {
    CAPTURE(step);
    Session session(kMaxMessage, nullptr);
    const Outcome outcome = feed(session, bytes, step);
    REQUIRE_FALSE(outcome.ended);
    REQUIRE(outcome.messages.size() == 3);
    CHECK(text_of(outcome.messages[0]) == "short");
    CHECK(outcome.messages[0].envelope.empty());
    CHECK(text_of(outcome.messages[1]) == std::string(999, 'x'));
    CHECK(outcome.messages[1].envelope == Envelope{""});
    CHECK(outcome.messages[2].bytes.size() == 0);
    CHECK(session.n_held() == 0);
  }
}

TEST_CASE("a message of several frames takes no memory and is refused once it is whole") {
  Session session(kMaxMessage, nullptr);
  REQUIRE_FALSE(feed(session, kHandshake + frame("", 1) + frame("first", 1)).ended);
  for (int i = 0; i < 500; ++i) {
    const Outcome outcome = feed(session, frame("", 1) + frame("further", 1));
    REQUIRE_FALSE(outcome.ended);
    REQUIRE(outcome.messages.empty());
    REQUIRE(session.n_held() == 5);
  }
  const Outcome outcome = feed(session, frame("last") + frame("next"));
  REQUIRE(outcome.messages.size() == 2);
  CHECK(outcome.messages[0].refused->code == Code::bad_request);
  CHECK(outcome.messages[0].refused->found == "several");
  CHECK(text_of(outcome.messages[1]) == "next");
  CHECK_FALSE(outcome.messages[1].refused);
}

TEST_CASE("frames before the empty one come back with the answer, however their bytes are cut") {
  const std::string bytes = kHandshake + frame(std::string("\0\0\0\7", 4), 1) + frame("", 1) + frame("request") +
                            frame("far", 1) + frame("near", 1) + frame("", 1) + frame("routed");
  for (std::size_t step : {1, 3, 64, 1 << 20}) {
    CAPTURE(step);
    Session session(kMaxMessage, nullptr);
    const Outcome outcome = feed(session, bytes, step);
    REQUIRE_FALSE(outcome.ended);
    REQUIRE(outcome.messages.size() == 2);
    CHECK_FALSE(outcome.messages[0].refused);
    CHECK(text_of(outcome.messages[0]) == "request");
    CHECK(outcome.messages[0].envelope == Envelope{std::string("\0\0\0\7", 4), ""});
    CHECK(outcome.messages[1].envelope == Envelope{"far", "near", ""});
    const std::string answer = session.pack("answer", outcome.messages[1].envelope);
    CHECK(answer == frame("far", 1) + frame("near", 1) + frame("", 1) + frame("answer"));
  }
}

TEST_CASE("frames without an empty one are several, and the first has the number") {
  for (const std::string& rest : {frame("last"), frame(std::string(300, 'x')), frame("more", 1) + frame("last"),
                                  frame(std::string(300, 'x'), 1) + frame("last")}) {
    Session session(kMaxMessage, nullptr);
    const Outcome outcome = feed(session, kHandshake + frame("number", 1) + rest + frame("next"));
    REQUIRE_FALSE(outcome.ended);
    REQUIRE(outcome.messages.size() == 2);
    REQUIRE(outcome.messages[0].refused);
    CHECK(outcome.messages[0].refused->found == "several");
    CHECK(text_of(outcome.messages[0]) == "number");
    CHECK(outcome.messages[0].envelope.empty());
    CHECK(text_of(outcome.messages[1]) == "next");
  }
}

TEST_CASE("a message of very many frames ends the connection") {
  std::string frames;
  for (int i = 0; i < 1100; ++i) frames += frame("", 1);
  CHECK(why_ended(kHandshake + frames) == "protocol");
  Session session(kMaxMessage, nullptr);
  const Outcome outcome = feed(
      session, kHandshake + [] {
        std::string messages;
        for (int i = 0; i < 1100; ++i) messages += frame("", 1) + frame("request");
        return messages;
      }());
  CHECK_FALSE(outcome.ended);
  CHECK(outcome.messages.size() == 1100);
}

TEST_CASE("a message over the limit is read over, and its first bytes are kept for its number") {
  Session session(kMaxMessage, nullptr);
  const Outcome outcome = feed(session, kHandshake + frame("number" + std::string(100'000, 'x')) + frame("next"));
  REQUIRE(outcome.messages.size() == 2);
  CHECK(outcome.messages[0].refused->code == Code::too_large);
  CHECK(text_of(outcome.messages[0]).starts_with("number"));
  CHECK(outcome.messages[0].bytes.size() <= 64);
  CHECK(outcome.messages[0].size == 100'006);
  CHECK(text_of(outcome.messages[1]) == "next");
}

TEST_CASE("only bytes that came are counted as held") {
  Session session(kMaxMessage, nullptr);
  REQUIRE_FALSE(feed(session, kHandshake + long_header(900) + std::string(300, 'x')).ended);
  CHECK(session.is_receiving());
  CHECK(session.n_held() == 300);
}

TEST_CASE("whatever is not ZMTP 3 of a client ends the connection, with a word why") {
  CHECK(why_ended("GET / HTTP/1.1\r\n\r\n") == "handshake");
  CHECK(why_ended(std::string("\x01\x00", 2)) == "handshake");
  CHECK(why_ended(greeting().replace(10, 1, "\2")) == "handshake");
  CHECK(why_ended(greeting("CURVE")) == "handshake");
  CHECK(why_ended(greeting() + frame("a message")) == "handshake");
  CHECK(why_ended(greeting() + frame("\x05WRONG", 4)) == "handshake");
  CHECK(why_ended(std::string(kHandshake).replace(kHandshake.size() - 6, 6, "PUBPUB")) == "handshake");
  CHECK(why_ended(kHandshake + std::string("\xf8\x03", 2)) == "protocol");
  CHECK(why_ended(kHandshake + frame("\x04"
                                     "EVIL",
                                     4)) == "protocol");
  CHECK(why_ended(kHandshake + long_header(std::uint64_t{1} << 63)) == "size");
  CHECK(why_ended(kHandshake + long_header(1 << 20, 6)) == "size");
  CHECK(why_ended(kHandshake) == "");
}

TEST_CASE("a heartbeat is answered with its context") {
  Session session(kMaxMessage, nullptr);
  feed(session, kHandshake);
  session.take_output();
  feed(session, frame(std::string("\x04PING\0\x0a"
                                  "context",
                                  14),
                      4));
  CHECK(session.take_output() == frame("\x04PONGcontext", 4));
}

TEST_CASE("no bytes of a peer do more than end its connection") {
  for (unsigned seed = 0; seed < 3000; ++seed) {
    std::mt19937 random(seed);
    std::string bytes = kHandshake + frame("", 1) + frame("request") + frame(std::string(300, 'y'));
    for (unsigned i = 0; i < 1 + random() % 4; ++i) bytes[random() % bytes.size()] = static_cast<char>(random());
    Session session(kMaxMessage, nullptr);
    const Outcome outcome = feed(session, bytes, 1 + random() % 100);
    for (const Message& message : outcome.messages) CHECK(message.bytes.size() <= kMaxMessage);
    CHECK(session.n_held() <= 2 * kMaxMessage);
  }
}

}  // namespace session_test
