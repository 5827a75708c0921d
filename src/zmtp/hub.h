// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <string_view>

#include "net/connections.h"
#include "net/loop.h"
#include "zmtp/session.h"

namespace vla::zmtp {

/// The peer of a connection.
struct Client {
  std::uint64_t connection = 0;
  std::string peer;              // the client's public key, or without keys its address, or `ipc` and its user
  std::string name;              // the name in its hello
  Clock::time_point since = {};  // since it connected
  std::uint64_t n_request = 0;   // received so far
};

/// The sockets of a ZeroMQ ROUTER: listeners and connections. Everything runs inside the loop's `wait`, which never
/// blocks on a peer. It does not read from a peer that leaves its answers unread.
class Hub {
 public:
  using Limits = net::ConnectionLimits;
  class Handler {
   public:
    virtual ~Handler() = default;
    virtual void received(Client& client, Message message) = 0;
    /// Called when the server ended a connection. `why` is one word: handshake, key, protocol, size, memory, silent,
    /// connections or receipt.
    virtual void dropped(const Client& client, const std::string& why, const std::string& detail) = 0;
  };

  /// `keys` may be null: then peers connect in clear text. Both must outlive the hub.
  Hub(net::Loop& loop, const Limits& limits, const CurveKeys* keys);
  ~Hub();

  /// Binds an endpoint that `reach_of` has read. Returns it with its port. Errors: io.
  Result<std::string> bind(const std::string& endpoint);
  /// Accepts connections from now on; call it before every turn of the loop. The handler must outlive the hub.
  void begin(Handler& handler);
  /// Sends an answer, unless the connection has ended or does not read its answers.
  void send(std::uint64_t connection, std::string_view response, const Envelope& envelope);
  /// Whether an answer is not sent yet.
  bool has_answers() const;

 private:
  class Sockets;
  std::unique_ptr<Sockets> sockets_;
};

}  // namespace vla::zmtp
