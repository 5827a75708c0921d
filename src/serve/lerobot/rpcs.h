// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <memory>
#include <string>

#include "base/result.h"
#include "serve/lerobot/connections.h"

namespace vla::serve::lerobot {

/// A call that came whole.
struct Rpc {
  std::uint64_t id = 0;
  Peer peer;
  std::string method;   // the last part of its name
  std::string message;  // of SendObservations the joined data of its pieces; else a serialized message
};

/// gRPC at one address. Its own threads receive; the handler is called inside the loop's `wait`.
class Rpcs {
 public:
  using Limits = net::ConnectionLimits;
  static constexpr std::size_t kMaxPiece = (2 << 20) + 1024;  // of a call: LeRobot's client cuts at 2 MiB
  class Handler {
   public:
    virtual ~Handler() = default;
    /// `answer` or `refuse` ends it, now or later.
    virtual void called(Rpc rpc) = 0;
    /// The client does not wait for it any more.
    virtual void cancelled(std::uint64_t id) = 0;
    /// A connection ended. Of one that the server ended, `why` is one word as Hub::Handler's; else empty.
    virtual void ended(const Peer& peer, const std::string& why, const std::string& detail) = 0;
  };

  Rpcs(net::Loop& loop, const Limits& limits);
  ~Rpcs();

  /// Binds an address as tcp_endpoint_of reads it. It with the port filled in. Errors: usage, io.
  Result<std::string> bind(const std::string& address, const char* option, bool insecure);
  /// Takes connections from now on; to be called before every turn of the loop. The handler outlives it.
  void begin(Handler& handler);
  /// Ends a call with a serialized message. One that has ended does not get it.
  void answer(std::uint64_t id, const std::string& message);
  /// Ends a call with gRPC's status for the error.
  void refuse(std::uint64_t id, const Error& error) noexcept;
  bool has_answers() const;

 private:
  class All;
  std::unique_ptr<All> all_;
};

}  // namespace vla::serve::lerobot
