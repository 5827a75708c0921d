// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <string>

#include "base/clock.h"
#include "base/result.h"
#include "engine/timing.h"
#include "wire/envelope.h"

namespace vla::observe {

using wire::Kind;
using wire::kind_name;

/// A request before its body is decoded.
struct Received {
  std::string client;            // identifies the connection; never reused
  std::string peer;              // the client's public key if there are keys, else its address
  std::string name;              // the client's name from a hello on this connection
  std::uint64_t request_id = 0;  // the client's number; 0 if it cannot be read
  Kind kind = Kind::unknown;
  std::size_t size = 0;  // bytes of the request
  Clock::time_point at;
  bool is_first = false;  // first request of its connection
};

/// A connection that the server ended.
struct Dropped {
  std::string client, peer, name;
  std::string
      why;  // handshake, key, protocol, size, memory, silent, connections, receipt, calls, flood, stalled or door
  std::string detail;
};

/// An answered request.
struct Answered {
  Received request;
  const Error* error = nullptr;         // null: answered as requested
  Clock::time_point started, finished;  // times in the engine; both `request.at` if it got no request
  Clock::time_point sent;               // handed to the socket
  Timing stages;                        // the engine's, "decode" first; empty if the request never reached it
  std::size_t n_sent = 0;               // bytes of the answer
  /// The serialized v1::Request and v1::Response, valid during the call only: those on the wire, or the equivalent of
  /// an act in another protocol. Empty if an act in another protocol was refused.
  std::span<const std::byte> in, out;
  bool out_of_range = false;           // answered though the state is beyond the bundle's bound
  int n_beyond = 0;                    // rows beyond --limits, in an answered chunk or in one refused for them
  std::span<const std::string> notes;  // the chunk's warnings, valid during the call only
  const char* code() const { return error == nullptr ? "ok" : code_name(error->code); }
};

/// Watches the server: metrics, logs, traces and recordings are observers. A call must not throw, and must return at
/// once: its thread has other clients to serve.
class Observer {
 public:
  virtual ~Observer() = default;
  virtual void received(const Received&) {}  // on the I/O thread
  virtual void dropped(const Dropped&) {}    // on the I/O thread
  virtual void started(const Received&) {}   // when an act leaves the queue, on the thread that prepares it
  virtual void answered(const Answered&) {}  // on the I/O thread
  /// Whether the observer needs `in` and `out` for acts of other protocols too. They must be encoded for that.
  virtual bool records() const { return false; }
};

/// The state of the server, from any thread.
struct Health {
  bool ready = false;         // takes acts; false while it drains
  std::size_t n_waiting = 0;  // acts in the queue
  bool computing = false;
  double uptime_s = 0;
  std::uint64_t n_chunk = 0, n_error = 0;  // requests answered with a chunk, with an error
};

}  // namespace vla::observe
