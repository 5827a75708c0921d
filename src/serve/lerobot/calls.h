// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>

#include "base/clock.h"
#include "base/result.h"

namespace vla::serve::lerobot {

/// The robot's end of a connection.
struct Peer {
  std::uint64_t connection = 0;  // a number that is never given again
  std::string address;           // 127.0.0.1
  Clock::time_point since = {};
};

/// A call of gRPC that came whole.
struct Rpc {
  std::uint64_t id = 0;
  Peer peer;
  std::string method;   // the last part of its name
  std::string message;  // of SendObservations the joined data of its pieces; else a serialized message
};

/// Whoever answers calls.
class CallHandler {
 public:
  virtual ~CallHandler() = default;
  /// `answer` or `refuse` ends it, now or later.
  virtual void called(Rpc rpc) = 0;
  /// The client does not wait for it any more.
  virtual void cancelled(std::uint64_t id) = 0;
  virtual void opened(const Peer& peer) = 0;
  /// Of a connection that was ended here, `why` is one word, as observe/observer.h has them; else empty.
  virtual void closed(const Peer& peer, const std::string& why, const std::string& detail) = 0;
};

/// How a call ends. One that has ended gets neither.
class Calls {
 public:
  virtual ~Calls() = default;
  /// With a serialized message.
  virtual void answer(std::uint64_t id, const std::string& message) = 0;
  /// With gRPC's status for the error.
  virtual void refuse(std::uint64_t id, const Error& error) noexcept = 0;
};

}  // namespace vla::serve::lerobot
