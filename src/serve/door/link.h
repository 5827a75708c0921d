// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <boost/asio/local/stream_protocol.hpp>
#include <cstdint>
#include <deque>
#include <memory>
#include <string>

#include "net/bytes.h"

namespace vla::serve {

/// A message between the server and the process of a front end.
struct LinkMessage {
  enum class Kind : std::uint32_t {
    // From the server:
    policy,    // text: the lines of --map, bytes: a v1::Description; acts may come from now on
    response,  // bytes: a v1::Response for the connection
    ping,
    // From the process:
    ready,    // once it has started
    pong,     // to a ping
    opened,   // text: the address of the connection
    request,  // bytes: a v1::Request of the connection
    refused,  // a call of the connection that never became a request
    closed,   // text: why the process ended the connection, in one word, and the detail after a space; or empty
    // From both: bytes that the process wants back when it is started again, by the key in text; no bytes: not any
    // more.
    keep
  };
  Kind kind = Kind::ping;
  std::uint64_t connection = 0;  // the process counts them from 1
  std::string text;
  net::Bytes bytes;
};

/// An end of the socket between the two. It trusts nobody: lengths are bounded before memory is taken.
class Link {
 public:
  static constexpr std::size_t kMaxText = 64 << 10;
  class Handler {
   public:
    virtual ~Handler() = default;
    virtual void came(LinkMessage message) = 0;
    /// The other end is gone, or sent what is no message. Nothing comes any more.
    virtual void broke(const std::string& why) = 0;
  };

  /// Takes the descriptor. `max_bytes`: of a message's bytes.
  Link(boost::asio::io_context& context, int descriptor, std::size_t max_bytes);
  ~Link();
  /// The handler outlives the link.
  void start(Handler& handler);
  void send(LinkMessage::Kind kind, std::uint64_t connection = 0, const std::string& text = {},
            std::string_view bytes = {});
  int descriptor() const;
  /// Bytes that have not left yet.
  std::size_t n_queued() const;

 private:
  class Ends;
  const std::shared_ptr<Ends> ends_;
};

}  // namespace vla::serve
