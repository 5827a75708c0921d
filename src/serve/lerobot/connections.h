// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <memory>
#include <optional>
#include <string>

#include "base/clock.h"
#include "base/result.h"
#include "net/connections.h"
#include "net/loop.h"

namespace vla::serve::lerobot {

/// The robot's end of a connection.
struct Peer {
  std::uint64_t connection = 0;  // a number that is never given again
  std::string address;           // 127.0.0.1
  Clock::time_point since = {};
};

/// The connections that gRPC serves, and what their calls hold. gRPC knows no share of a peer: so connections are taken
/// here, gRPC gets a second descriptor of each, and the one that stays ends those that give way. What is not said to be
/// of the loop is for any thread.
class Connections {
 public:
  static constexpr std::size_t kMaxCalls = 16;  // of a connection at once
  class Handler {
   public:
    virtual ~Handler() = default;
    /// A descriptor to be served, and closed after it.
    virtual void came(int descriptor) = 0;
    /// All of its calls end, or have ended. Of one that gave way, `why` is one word as Hub::Handler's; else empty.
    virtual void ended(const Peer& peer, const std::string& why, const std::string& detail) = 0;
  };

  /// `limits.connections` is also how many calls run at once.
  Connections(net::Loop& loop, const net::ConnectionLimits& limits);
  ~Connections();

  /// Binds an address as tcp_endpoint_of reads it. It with the port filled in. Errors: usage, io.
  Result<std::string> bind(const std::string& address, const char* option, bool insecure);
  /// Begins to listen, before any turn of the loop, in whose `wait` the handler is called.
  void begin(Handler& handler);

  /// A call begins at gRPC's name of a peer, as ipv4:127.0.0.1:40000, for which gRPC may hold so many bytes that it has
  /// not handed over. Null where that peer has ended.
  std::optional<Peer> call_begins(const std::string& peer, std::size_t n_byte);
  /// It has received so many bytes more.
  void receives(std::uint64_t connection, std::size_t n_byte);
  /// It came whole, or ended before: none of its bytes is in receipt any more.
  void received(std::uint64_t connection, std::size_t n_byte, bool is_whole);
  void call_ends(std::uint64_t connection);

 private:
  class All;
  std::unique_ptr<All> all_;
};

}  // namespace vla::serve::lerobot
