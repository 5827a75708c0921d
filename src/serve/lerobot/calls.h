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
  std::uint64_t connection = 0;  // unique, never reused
  std::string address;           // 127.0.0.1
  Clock::time_point since = {};
};

/// A complete gRPC call.
struct Rpc {
  std::uint64_t id = 0;
  Peer peer;
  std::string method;   // the last part of its path
  std::string message;  // SendObservations: the joined data of its pieces; else a serialized message
};

/// Receives calls, and answers them by `Calls`.
class CallHandler {
 public:
  virtual ~CallHandler() = default;
  /// Handles a call; `answer` or `refuse` ends it, now or later.
  virtual void called(Rpc rpc) = 0;
  /// The client no longer waits for the call.
  virtual void cancelled(std::uint64_t id) = 0;
  virtual void opened(const Peer& peer) = 0;
  /// A connection has ended. `why`: one word of observe/observer.h if it was ended here, else empty.
  virtual void closed(const Peer& peer, const std::string& why, const std::string& detail) = 0;
};

/// Ends calls; each call at most once.
class Calls {
 public:
  virtual ~Calls() = default;
  /// Answers with a serialized message.
  virtual void answer(std::uint64_t id, const std::string& message) = 0;
  /// Answers with the gRPC status of the error.
  virtual void refuse(std::uint64_t id, const Error& error) noexcept = 0;
};

}  // namespace vla::serve::lerobot
