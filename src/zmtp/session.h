// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "base/result.h"
#include "net/bytes.h"
#include "zmtp/curve_session.h"

namespace vla::zmtp {

/// The frames before a message; its answer begins with the same frames. A REQ socket sends an empty frame. Before it
/// comes the request's number, if the socket correlates requests, or the addresses that proxies add. A DEALER socket
/// sends none.
using Envelope = std::vector<std::string>;

/// One message of a peer.
struct Message {
  net::Bytes bytes;              // bytes of its frame; only the first ones if the message is refused
  Envelope envelope;             // frames up to and including the empty one
  std::size_t size = 0;          // size that the peer announced
  std::optional<Error> refused;  // bad_request (several frames), too_large, out_of_memory
};

/// The server's side of ZMTP 3 (ZeroMQ RFC 23) for one connection, without its socket: bytes in, messages out. A frame
/// takes memory only as its bytes arrive, and a skipped frame takes none. Frames after a message's first are skipped,
/// up to a limit.
class Session {
 public:
  /// Without `keys` peers connect in clear text; with them both sides prove their keys. `keys` must outlive the
  /// session.
  Session(std::size_t max_message, const CurveKeys* keys);

  /// Where to put the peer's next bytes, and how many at most.
  std::span<std::byte> room();
  void filled(std::size_t n);
  /// The next complete message of the received bytes, or none. After an error the connection must end; the error's
  /// place is one word: `handshake`, `key`, `protocol`, `size` or `memory`.
  Result<std::optional<Message>> next();
  /// Bytes to send before anything else: greeting, handshake, answers to heartbeats.
  std::string take_output() { return std::exchange(output_, {}); }

  /// Encodes a message or a heartbeat for the socket. Call it after the handshake.
  std::string pack(std::string_view content, const Envelope& envelope);
  std::string ping();

  bool is_open() const { return state_ == State::open; }
  /// Whether a message has begun and is incomplete. `n_held`: bytes of it in memory.
  bool is_receiving() const { return in_frame_ || message_.has_value(); }
  std::size_t n_held() const;
  /// The client's public key in Z85, if there are keys.
  const std::string& client_key() const { return curve_ ? curve_->client_key() : no_key_; }

 private:
  enum class State { greeting, handshake, open };
  std::span<std::byte> staged() { return std::span(staging_).subspan(begin_, end_ - begin_); }
  Status greet();
  Result<bool> begin_frame();
  Status choose_memory();
  void fill_frame();
  Result<std::optional<Message>> end_frame();
  Status handshake(std::span<const std::byte> command);
  Status heartbeat(std::span<const std::byte> command);
  bool is_addressed() const;
  void refuse_several();
  std::optional<Message> end_part(bool more);
  void put(std::string& out, std::string_view content, unsigned flags);

  const std::size_t max_message_;
  std::optional<CurveSession> curve_;
  State state_ = State::greeting;
  std::array<std::byte, 4096> staging_;  // received bytes that belong to no frame yet, from begin_ to end_
  std::size_t begin_ = 0, end_ = 0;
  bool filling_frame_ = false;  // whether the last room() was part of `frame_`

  bool in_frame_ = false;
  unsigned flags_ = 0;
  std::uint64_t size_ = 0, got_ = 0;
  net::Bytes frame_;  // kept bytes of the current frame

  std::optional<Message> message_;
  int n_part_ = 0, n_frame_ = 0;  // kept parts of `message_`, and all its frames so far
  std::string output_;
  const std::string no_key_;
};

}  // namespace vla::zmtp
