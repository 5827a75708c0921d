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
  Clock::time_point since = {};         // since it connected
  std::uint64_t n_request = 0;          // received so far
  std::optional<double> total_ms = {};  // from receiving the last request to sending its answer
};

/// WebSocket connections at one address, and HTTP's `/healthz`. Everything runs inside the loop's `wait`, which never
/// blocks on a peer. A connection has one request in progress; one later message waits in memory. Pings are always
/// answered.
class Sockets {
 public:
  using Limits = net::ConnectionLimits;
  class Handler {
   public:
    virtual ~Handler() = default;
    /// Returns the first message of a connection.
    virtual std::string greeting() const = 0;
    /// Handles a message. `send` or `fail` answers it, now or later.
    virtual void received(Peer& peer, std::string message, bool is_text) = 0;
    /// Called when the server ended a connection. `why` is one word, as in Hub::Handler.
    virtual void dropped(const Peer& peer, const std::string& why, const std::string& detail) = 0;
  };

  /// `api_key`: clients must send `Authorization: Api-Key KEY`; empty: no check.
  Sockets(net::Loop& loop, const Limits& limits, std::string api_key);
  ~Sockets();

  /// Binds an address (see tcp_endpoint_of). Returns it with its port. Errors: usage, io.
  Result<std::string> bind(const std::string& address, const char* option, bool insecure);
  /// Accepts connections from now on; call it before every turn of the loop. The handler must outlive this.
  void begin(Handler& handler);
  /// Sends a binary message, unless the connection has ended.
  void send(std::uint64_t connection, std::string message);
  /// Sends a text message, then closes with code 1011, as the reference reports an error.
  void fail(std::uint64_t connection, std::string text);
  /// Closes without a message, if there is no memory for one.
  void drop(std::uint64_t connection) noexcept;
  bool has_answers() const;

 private:
  class All;
  std::unique_ptr<All> all_;
};

}  // namespace vla::serve::openpi
