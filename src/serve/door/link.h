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

/// A message between the server and a front end's process.
struct LinkMessage {
  enum class Kind : std::uint32_t {
    // From the server:
    policy,    // text: the lines of --map and the absent views; bytes: a v1::Description; from now on acts may arrive
    response,  // bytes: a v1::Response for the connection
    ping,
    // From the process:
    ready,    // sent once it has started
    pong,     // the answer to a ping
    opened,   // text: the address of the connection
    request,  // bytes: a v1::Request from the connection
    refused,  // a call of the connection that was refused before it became a request
    closed,   // text: why the process ended the connection, as one word, a space and details; or empty
    // In both directions: data that the process wants back after a restart, with its key in text; no bytes: forget it.
    keep
  };
  Kind kind = Kind::ping;
  std::uint64_t connection = 0;  // numbered by the process from 1
  std::string text;
  net::Bytes bytes;
};

/// One end of the socket between server and process. It trusts neither side: it checks lengths before it allocates.
class Link {
 public:
  static constexpr std::size_t kMaxText = 64 << 10;
  class Handler {
   public:
    virtual ~Handler() = default;
    virtual void came(LinkMessage message) = 0;
    /// The other end is gone or has sent an invalid message. No more messages follow.
    virtual void broke(const std::string& why) = 0;
  };

  /// Takes ownership of the descriptor. `max_bytes` limits a message's bytes.
  Link(boost::asio::io_context& context, int descriptor, std::size_t max_bytes);
  ~Link();
  /// The handler must outlive the link.
  void start(Handler& handler);
  void send(LinkMessage::Kind kind, std::uint64_t connection = 0, const std::string& text = {},
            std::string_view bytes = {});
  int descriptor() const;
  /// Bytes that are still queued.
  std::size_t n_queued() const;

 private:
  class Ends;
  const std::shared_ptr<Ends> ends_;
};

}  // namespace vla::serve
