// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <sodium.h>

#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <string>

#include "fuzz/budget.h"
#include "zmtp/session.h"

namespace vla::fuzz {

/// The client's side of CURVE (ZeroMQ RFC 26), so that bytes from a fuzzer are also met behind the handshake. Its keys
/// are the same in every run.
class CurveClient {
 public:
  CurveClient() {
    pair_of(1, server_public_, server_secret_);
    pair_of(2, public_, secret_);
    pair_of(3, transient_public_, transient_secret_);
  }
  zmtp::CurveKeys server_keys() const {
    zmtp::CurveKeys keys;
    std::copy_n(server_secret_, 32, keys.secret.begin());
    std::copy_n(server_public_, 32, keys.own_public.begin());
    keys.clients.emplace(reinterpret_cast<const char*>(public_), 32);
    return keys;
  }

  std::string hello() {
    std::string command("\x05HELLO\x01\x00", 8);
    command.resize(80);
    command.append(text(transient_public_));
    return command + box("CurveZMQHELLO---", std::string(64, '\0'), server_public_);
  }
  /// What came from the server since HELLO: a frame with WELCOME. Any other leaves the client as it is.
  void welcome(const std::string& frame) {
    constexpr std::size_t kWelcome = 168, kNonce = 10, kBox = 26;
    if (frame.size() < 2 + kWelcome) return;
    unsigned char content[128];
    if (crypto_box_open_easy(content, bytes(frame, kBox), 144, bytes(nonce("WELCOME-", frame.substr(kNonce, 16))),
                             server_public_, transient_secret_) != 0)
      return;
    std::copy_n(content, 32, server_transient_);
    cookie_.assign(reinterpret_cast<const char*>(content) + 32, 96);
  }
  std::string initiate(const std::string& metadata) {
    const std::string vouch_nonce(16, '\7'), vouched = text(transient_public_) + text(server_public_);
    std::string vouch(80, '\0');
    if (crypto_box_easy(writable(vouch), bytes(vouched), 64, bytes(nonce("VOUCH---", vouch_nonce)), server_transient_,
                        secret_) != 0)
      return {};
    return "\x08INITIATE" + cookie_ +
           box("CurveZMQINITIATE", text(public_) + vouch_nonce + vouch + metadata, server_transient_);
  }
  std::string message(const std::string& content) {
    return "\x07MESSAGE" + box("CurveZMQMESSAGEC", content, server_transient_);
  }

 private:
  using Key = unsigned char[32];
  static void pair_of(unsigned char seed, Key& its_public, Key& its_secret) {
    unsigned char seeds[crypto_box_SEEDBYTES];
    std::fill(std::begin(seeds), std::end(seeds), seed);
    if (crypto_box_seed_keypair(its_public, its_secret, seeds) != 0) std::abort();
  }
  static std::string text(const Key& key) { return {reinterpret_cast<const char*>(key), sizeof(Key)}; }
  static const unsigned char* bytes(const std::string& from, std::size_t at = 0) {
    return reinterpret_cast<const unsigned char*>(from.data()) + at;
  }
  static unsigned char* writable(std::string& to) { return reinterpret_cast<unsigned char*>(to.data()); }
  static std::string nonce(std::string_view prefix, const std::string& rest) { return std::string(prefix) + rest; }

  /// A short nonce, and the box that it goes with.
  std::string box(std::string_view prefix, const std::string& content, const Key& to) {
    std::string short_nonce(8, '\0'), sealed(content.size() + 16, '\0');
    for (std::size_t i = 0; i < 8; ++i) short_nonce[i] = static_cast<char>(nonce_ >> (56 - 8 * i));
    ++nonce_;
    if (crypto_box_easy(writable(sealed), bytes(content), content.size(), bytes(nonce(prefix, short_nonce)), to,
                        transient_secret_) != 0)
      return {};
    return short_nonce + sealed;
  }

  Key server_public_, server_secret_, public_, secret_, transient_public_, transient_secret_, server_transient_ = {};
  std::string cookie_;
  std::uint64_t nonce_ = 1;
};

/// Plays a peer: the first byte says whether there are keys and how its bytes are cut, then come pieces of a kind, a
/// length and a content. Aborts when a session keeps more than its limits or ends without saying why. Returns how many
/// messages came out.
inline int check_session(std::string_view input) {
  constexpr std::size_t kMaxMessage = 300;
  const Budget budget(5, 256);
  if (input.empty()) return 0;
  const bool has_keys = (input[0] & 1) != 0;
  const std::size_t step = 1 + static_cast<unsigned char>(input[0]) / 2;
  input.remove_prefix(1);
  CurveClient client;
  const zmtp::CurveKeys keys = client.server_keys();
  zmtp::Session session(kMaxMessage, has_keys ? &keys : nullptr);
  session.take_output();
  int n_message = 0;

  const auto frame = [](const std::string& content, int flags) {
    std::string out(1, static_cast<char>(flags | 2));
    for (int shift = 56; shift >= 0; shift -= 8) out += static_cast<char>(content.size() >> shift);
    return out + content;
  };
  const auto piece = [&](int kind, const std::string& content) {
    switch (kind) {
      case 0: {
        std::string greeting("\xff\0\0\0\0\0\0\0\1\x7f\3\1", 12);
        greeting.append(has_keys ? "CURVE" : "NULL").resize(64);
        return greeting;
      }
      case 1:
        return frame(has_keys ? client.hello() : "\x05READY" + content, 4);
      case 2:
        return has_keys ? frame(client.initiate(content), 4) : frame(content, 1);
      case 3:
        return frame(has_keys ? client.message(content) : content, 0);
      case 4:
        return frame(content, 4);
      default:
        return content;
    }
  };
  /// False once the session has ended.
  const auto take = [&](std::string_view bytes) {
    while (!bytes.empty()) {
      const std::span<std::byte> room = session.room();
      const std::size_t n = std::min({room.size(), step, bytes.size()});
      if (n == 0) std::abort();
      std::memcpy(room.data(), bytes.data(), n);
      bytes.remove_prefix(n);
      session.filled(n);
      for (;;) {
        const auto message = session.next();
        if (!message) {
          const Error& error = message.error();
          if (error.where.empty() || error.found.empty() || error.message().size() > 4096) std::abort();
          return false;
        }
        if (session.n_held() > 2 * (kMaxMessage + 64)) std::abort();
        if (!*message) break;
        if ((*message)->bytes.size() > kMaxMessage) std::abort();
        ++n_message;
      }
      client.welcome(session.take_output());
    }
    return true;
  };

  while (input.size() >= 2) {
    const auto size = std::min<std::size_t>(static_cast<unsigned char>(input[1]), input.size() - 2);
    if (!take(piece(input[0] & 7, std::string(input.substr(2, size))))) break;
    input.remove_prefix(2 + size);
  }
  return n_message;
}

}  // namespace vla::fuzz
