// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "zmtp/curve_session.h"

#include <sodium.h>
#include <zmq.h>

#include <algorithm>
#include <cstring>
#include <string_view>

namespace vla::zmtp {
namespace {

constexpr std::size_t kKey = 32, kMac = 16, kShortNonce = 8, kLongNonce = 16, kCookie = 96;
constexpr std::size_t kHello = 200, kVouch = kMac + 2 * kKey;
constexpr std::string_view kHelloMark("\x05HELLO\x01\x00", 8), kInitiateMark("\x08INITIATE", 9),
    kMessageMark("\x07MESSAGE", 8);

using Nonce = std::array<unsigned char, 24>;

/// A nonce: the RFC's prefix and the bytes that make it unique.
Nonce nonce_of(std::string_view prefix, const unsigned char* rest) {
  Nonce nonce;
  std::copy(prefix.begin(), prefix.end(), nonce.begin());
  std::copy_n(rest, nonce.size() - prefix.size(), nonce.begin() + static_cast<std::ptrdiff_t>(prefix.size()));
  return nonce;
}

std::span<const unsigned char> unsigned_of(std::span<const std::byte> bytes) {
  return {reinterpret_cast<const unsigned char*>(bytes.data()), bytes.size()};
}

bool starts_with(std::span<const unsigned char> bytes, std::string_view mark) {
  return bytes.size() >= mark.size() && std::memcmp(bytes.data(), mark.data(), mark.size()) == 0;
}

Error refused(const char* where, std::string expected, std::string found = "something else") {
  return {Code::bad_request, where, std::move(expected), std::move(found)};
}

unsigned char* writable(std::string& text, std::size_t at) {
  return reinterpret_cast<unsigned char*>(text.data()) + at;
}

}  // namespace

Result<CurveSession::Reply> CurveSession::handshake(std::span<const std::byte> command) {
  if (state_ == State::hello) return hello(unsigned_of(command));
  if (state_ == State::initiate) return initiate(unsigned_of(command));
  return refused("handshake", "messages after the handshake", "a command of it");
}

Status CurveSession::take_nonce(const unsigned char* short_nonce, const char* where) {
  std::uint64_t value = 0;
  for (std::size_t i = 0; i < kShortNonce; ++i) value = value << 8 | short_nonce[i];
  if (value <= peer_nonce_) return refused(where, "a nonce that was not used yet", "an old one");
  peer_nonce_ = value;
  return {};
}

/// HELLO: mark and version 8, padding 72, the client's transient key 32, nonce 8, box of 64 zeros 80.
Result<CurveSession::Reply> CurveSession::hello(std::span<const unsigned char> command) {
  if (command.size() != kHello || !starts_with(command, kHelloMark))
    return refused("handshake", "a HELLO of CURVE 1.0");
  std::copy_n(command.data() + 80, kKey, client_transient_.begin());
  const unsigned char* const short_nonce = command.data() + 112;
  VLA_CHECK(take_nonce(short_nonce, "handshake"));
  std::array<unsigned char, 64> zeros;
  if (crypto_box_open_easy(zeros.data(), command.data() + 120, zeros.size() + kMac,
                           nonce_of("CurveZMQHELLO---", short_nonce).data(), client_transient_.data(),
                           keys_.secret.data()) != 0)
    return refused("handshake", "a HELLO to this server's key", "one to another");

  crypto_box_keypair(own_transient_public_.data(), own_transient_secret_.data());
  randombytes_buf(cookie_.data(), cookie_.size());
  std::array<unsigned char, kKey + kCookie> content;
  std::copy(own_transient_public_.begin(), own_transient_public_.end(), content.begin());
  std::copy(cookie_.begin(), cookie_.end(), content.begin() + kKey);
  std::string welcome("\x07WELCOME");
  welcome.resize(welcome.size() + kLongNonce + kMac + content.size());
  randombytes_buf(writable(welcome, 8), kLongNonce);
  if (crypto_box_easy(writable(welcome, 8 + kLongNonce), content.data(), content.size(),
                      nonce_of("WELCOME-", writable(welcome, 8)).data(), client_transient_.data(),
                      keys_.secret.data()) != 0)
    return refused("handshake", "a transient key", "one that cannot be used");
  state_ = State::initiate;
  return Reply{std::move(welcome), {}, false};
}

/// INITIATE: mark 9, cookie 96, nonce 8, box of the client's key 32, the vouch's nonce 16 and box 80, and metadata.
Result<CurveSession::Reply> CurveSession::initiate(std::span<const unsigned char> command) {
  constexpr std::size_t kAt = 9 + kCookie + kShortNonce, kFixed = kKey + kLongNonce + kVouch;
  if (command.size() < kAt + kMac + kFixed || !starts_with(command, kInitiateMark) ||
      sodium_memcmp(command.data() + 9, cookie_.data(), kCookie) != 0)
    return refused("handshake", "an INITIATE with the server's cookie");
  const unsigned char* const short_nonce = command.data() + 9 + kCookie;
  VLA_CHECK(take_nonce(short_nonce, "handshake"));
  std::string content(command.size() - kAt - kMac, '\0');
  if (crypto_box_open_easy(writable(content, 0), command.data() + kAt, command.size() - kAt,
                           nonce_of("CurveZMQINITIATE", short_nonce).data(), client_transient_.data(),
                           own_transient_secret_.data()) != 0)
    return refused("handshake", "an INITIATE by the one who said HELLO");

  // Only the owner of the client's long-term secret key can have vouched for its transient key to this server.
  const unsigned char *const client = writable(content, 0), *const vouch_nonce = client + kKey;
  std::array<unsigned char, 2 * kKey> vouch;
  if (crypto_box_open_easy(vouch.data(), vouch_nonce + kLongNonce, kVouch, nonce_of("VOUCH---", vouch_nonce).data(),
                           client, own_transient_secret_.data()) != 0 ||
      sodium_memcmp(vouch.data(), client_transient_.data(), kKey) != 0 ||
      sodium_memcmp(vouch.data() + kKey, keys_.own_public.data(), kKey) != 0)
    return refused("handshake", "a vouch of the client's own key");
  std::array<char, 41> text;
  zmq_z85_encode(text.data(), client, kKey);
  client_key_ = text.data();
  if (!keys_.clients.contains(content.substr(0, kKey)))
    return Reply{
        "\x05"
        "ERROR"
        "\x03"
        "400",
        {},
        true};
  if (crypto_box_beforenm(shared_.data(), client_transient_.data(), own_transient_secret_.data()) != 0)
    return refused("handshake", "a transient key", "one that cannot be used");
  sodium_memzero(own_transient_secret_.data(), own_transient_secret_.size());
  state_ = State::open;
  const std::string metadata("\x0bSocket-Type\0\0\0\x06ROUTER", 22);
  return Reply{box("CurveZMQREADY---", "\x05READY", metadata), content.substr(kFixed), false};
}

std::string CurveSession::box(const char* prefix, const std::string& command, const std::string& content) {
  std::string out = command;
  for (int shift = 56; shift >= 0; shift -= 8) out += static_cast<char>(nonce_ >> shift);
  ++nonce_;
  const std::size_t at = out.size();
  out.resize(at + kMac + content.size());
  crypto_box_easy_afternm(writable(out, at), reinterpret_cast<const unsigned char*>(content.data()), content.size(),
                          nonce_of(prefix, writable(out, at - kShortNonce)).data(), shared_.data());
  return out;
}

std::string CurveSession::seal(const std::string& content) {
  return box("CurveZMQMESSAGES", std::string(kMessageMark), content);
}

Status CurveSession::open(std::span<std::byte> message) {
  const std::span<const unsigned char> bytes = unsigned_of(message);
  if (bytes.size() <= kOverhead || !starts_with(bytes, kMessageMark)) return refused("protocol", "a MESSAGE of CURVE");
  const unsigned char* const short_nonce = bytes.data() + kMessageMark.size();
  const Nonce nonce = nonce_of("CurveZMQMESSAGEC", short_nonce);
  VLA_CHECK(take_nonce(short_nonce, "protocol"));
  const std::size_t at = kMessageMark.size() + kShortNonce;
  auto* const content = reinterpret_cast<unsigned char*>(message.data()) + kOverhead;
  if (crypto_box_open_easy_afternm(content, bytes.data() + at, bytes.size() - at, nonce.data(), shared_.data()) != 0)
    return refused("protocol", "a MESSAGE of this client", "one that was changed");
  return {};
}

}  // namespace vla::zmtp
