// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <set>
#include <span>
#include <string>

#include "base/result.h"

namespace vla::zmtp {

/// Keys of a server, as bytes.
struct CurveKeys {
  std::array<unsigned char, 32> secret = {}, own_public = {};
  std::set<std::string> clients;  // public keys of admitted clients, 32 bytes each
};

/// The server's side of CurveZMQ (ZeroMQ RFC 26) for one connection: three commands each way, then boxes. The peer's
/// nonces must rise, which prevents replays. Errors have the code `bad_request`. Their place is `key` for a client that
/// is not listed, else `handshake` or `protocol`.
class CurveSession {
 public:
  explicit CurveSession(const CurveKeys& keys) : keys_(keys) {}

  struct Reply {
    std::string command;
    std::string metadata;  // metadata of the client's INITIATE; empty before
    bool refused = false;  // the connection ends after this command is sent
  };
  /// The server's answer to a HELLO or an INITIATE.
  Result<Reply> handshake(std::span<const std::byte> command);
  bool is_open() const { return state_ == State::open; }
  /// The client's proven long-term public key: 40 characters of Z85.
  const std::string& client_key() const { return client_key_; }

  /// How many bytes a box adds to its content.
  static constexpr std::size_t kOverhead = 8 + 8 + 16;
  /// Decrypts a MESSAGE in place. Its content, which begins with a byte of flags, is at `kOverhead`. Errors: protocol.
  Status open(std::span<std::byte> message);
  /// Encrypts this content as a MESSAGE.
  std::string seal(const std::string& content);

 private:
  enum class State { hello, initiate, open };
  Result<Reply> hello(std::span<const unsigned char> command);
  Result<Reply> initiate(std::span<const unsigned char> command);
  Status take_nonce(const unsigned char* short_nonce, const char* where);
  std::string box(const char* prefix, const std::string& command, const std::string& content);

  const CurveKeys& keys_;
  State state_ = State::hello;
  std::array<unsigned char, 32> client_transient_ = {}, own_transient_secret_ = {}, own_transient_public_ = {},
                                shared_ = {};
  std::array<unsigned char, 96> cookie_ = {};
  std::uint64_t nonce_ = 1, peer_nonce_ = 0;
  std::string client_key_;
};

}  // namespace vla::zmtp
