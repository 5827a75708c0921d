// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <memory>
#include <optional>
#include <string>

#include "base/result.h"
#include "net/connections.h"
#include "net/loop.h"

namespace vla::serve::openpi {

/// The peer of a connection.
struct Peer {
  std::uint64_t connection = 0;
  std::string address;
  Clock::time_point since = {};         // it is connected
  std::uint64_t n_request = 0;          // that came so far
  std::optional<double> total_ms = {};  // from the receipt of the last request to its answer's departure
};

/// WebSocket connections at one address, and HTTP's `/healthz`. All of it runs inside the loop's `wait`, and no peer is
/// waited for. A connection has one request in work: what it sends meanwhile waits, one message of it in memory. Pings
/// are answered at all times.
class Sockets {
 public:
  using Limits = net::ConnectionLimits;
  class Handler {
   public:
    virtual ~Handler() = default;
    /// The first message of a connection.
    virtual std::string greeting() const = 0;
    /// A message, which `send` or `fail` answers, now or later.
    virtual void received(Peer& peer, std::string message, bool is_text) = 0;
    /// A connection that the server ended. `why` is one word, as Hub::Handler's.
    virtual void dropped(const Peer& peer, const std::string& why, const std::string& detail) = 0;
  };

  /// `api_key`: what clients have to send as `Authorization: Api-Key KEY`; empty: whatever they send.
  Sockets(net::Loop& loop, const Limits& limits, std::string api_key);
  ~Sockets();

  /// Binds an address as tcp_endpoint_of reads it. It with the port filled in. Errors: usage, io.
  Result<std::string> bind(const std::string& address, const char* option, bool insecure);
  /// Takes connections from now on; to be called before every turn of the loop. The handler outlives it.
  void begin(Handler& handler);
  /// A binary message. A connection that has ended does not get it.
  void send(std::uint64_t connection, std::string message);
  /// A text message, then the end with code 1011, as the reference tells of an error.
  void fail(std::uint64_t connection, std::string text);
  /// Ends it without a word, where there is no memory for one.
  void drop(std::uint64_t connection) noexcept;
  bool has_answers() const;

 private:
  class All;
  std::unique_ptr<All> all_;
};

}  // namespace vla::serve::openpi
