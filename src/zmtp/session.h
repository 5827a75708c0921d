// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <string>

#include "base/result.h"
#include "net/bytes.h"
#include "zmtp/curve_session.h"

namespace vla::zmtp {

/// One message of a peer.
struct Message {
  net::Bytes bytes;              // of its frame; the first ones only, where the message is refused
  bool delimiter = false;        // an empty frame came before it, as from REQ sockets
  std::size_t size = 0;          // of the frame as the peer announced it
  std::optional<Error> refused;  // bad_request (several frames), too_large, out_of_memory
};

/// The server's side of ZMTP 3 (ZeroMQ RFC 23) for one connection, without its socket: bytes in, messages out. A frame
/// takes memory only as its bytes come, one that is not kept takes none, and what follows the first frame of a message
/// is read over, up to a limit.
class Session {
 public:
  /// Without `keys` peers connect in clear text; else both sides have to prove theirs. `keys` outlive the session.
  Session(std::size_t max_message, const CurveKeys* keys);

  /// The place for the peer's next bytes, and how many at most.
  std::span<std::byte> room();
  void filled(std::size_t n);
  /// The next message among the bytes that came; none where more have to come. After an error the connection ends; its
  /// place says in a word why: `handshake`, `key`, `protocol`, `size` or `memory`.
  Result<std::optional<Message>> next();
  /// The bytes that the peer has to get before anything else: greeting, handshake, answers to its heartbeats.
  std::string take_output() { return std::exchange(output_, {}); }

  /// A message, or a heartbeat, as it goes over the socket. After the handshake.
  std::string pack(std::string_view content, bool delimiter);
  std::string ping();

  bool is_open() const { return state_ == State::open; }
  /// A message has begun and is not whole yet. `n_held`: the bytes of it that take memory.
  bool is_receiving() const { return in_frame_ || message_.has_value(); }
  std::size_t n_held() const;
  /// The client's public key in Z85, where there are keys.
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
  std::optional<Message> end_part(bool more);
  void put(std::string& out, std::string_view content, unsigned flags);

  const std::size_t max_message_;
  std::optional<CurveSession> curve_;
  State state_ = State::greeting;
  std::array<std::byte, 4096> staging_;  // bytes that came and are not part of a frame yet, from begin_ to end_
  std::size_t begin_ = 0, end_ = 0;
  bool filling_frame_ = false;  // `room` was in the frame itself

  bool in_frame_ = false;
  unsigned flags_ = 0;
  std::uint64_t size_ = 0, got_ = 0;
  net::Bytes frame_;  // as many of its bytes as are kept

  std::optional<Message> message_;
  int n_part_ = 0, n_frame_ = 0;  // of `message_`: parts that are kept, and all frames that came
  std::string output_;
  const std::string no_key_;
};

}  // namespace vla::zmtp
