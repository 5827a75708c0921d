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
  std::string peer;              // with keys, the client's public key; else its address, or `ipc` and its user
  std::string name;              // as it calls itself in a hello
  Clock::time_point since = {};  // it is connected
  std::uint64_t n_request = 0;   // that came so far
};

/// The sockets of a ZeroMQ ROUTER: what listens, and the connections that came. All of it runs inside the loop's
/// `wait`, and no peer is waited for. A peer that asks faster than it reads is not read from meanwhile.
class Hub {
 public:
  using Limits = net::ConnectionLimits;
  class Handler {
   public:
    virtual ~Handler() = default;
    virtual void received(Client& client, Message message) = 0;
    /// A connection that the server ended. `why` is one word: handshake, key, protocol, size, memory, silent,
    /// connections or receipt.
    virtual void dropped(const Client& client, const std::string& why, const std::string& detail) = 0;
  };

  /// `keys` may be null: peers connect in clear text. Both outlive the hub.
  Hub(net::Loop& loop, const Limits& limits, const CurveKeys* keys);
  ~Hub();

  /// Binds an endpoint that `reach_of` has read. The endpoint with the port filled in. Errors: io.
  Result<std::string> bind(const std::string& endpoint);
  /// Takes connections from now on; to be called before every turn of the loop. The handler outlives the hub.
  void begin(Handler& handler);
  /// Sends an answer. A connection that has ended, or that does not read its answers, does not get it.
  void send(std::uint64_t connection, std::string_view response, bool delimiter);
  /// Whether an answer has not left yet.
  bool has_answers() const;

 private:
  class Sockets;
  std::unique_ptr<Sockets> sockets_;
};

}  // namespace vla::zmtp
