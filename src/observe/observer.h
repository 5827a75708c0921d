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

/// A request as the server knows it before it has looked into it.
struct Received {
  std::string client;            // the connection: a number that is never given again
  std::string peer;              // who is there: the client's public key where there are keys, else its address
  std::string name;              // as the client called itself in a hello on this connection
  std::uint64_t request_id = 0;  // the client's number; 0 where it could not be read
  Kind kind = Kind::unknown;
  std::size_t size = 0;  // bytes of the request
  Clock::time_point at;
  bool is_first = false;  // of its connection
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
  Clock::time_point started, finished;  // of the engine; both `request.at` where the engine never saw the request
  Clock::time_point sent;               // handed to the socket
  Timing stages;                        // of the engine, "decode" first; empty where it never saw the request
  std::size_t n_sent = 0;               // bytes of the answer
  /// The serialized v1::Request and v1::Response, valid during the call only: those that went over the wire, or what an
  /// act of another protocol would have been. Empty where it was refused in that protocol.
  std::span<const std::byte> in, out;
  bool out_of_range = false;           // answered though the state is beyond the bundle's bound
  int n_beyond = 0;                    // rows outside of --limits of a chunk that was answered or refused for them
  std::span<const std::string> notes;  // of the chunk: warnings, valid during the call only
  const char* code() const { return error == nullptr ? "ok" : code_name(error->code); }
};

/// Watches the server: metrics, logs, traces and recordings are observers. A call must return at once, since the thread
/// that makes it has other clients to serve, and must not throw.
class Observer {
 public:
  virtual ~Observer() = default;
  virtual void received(const Received&) {}  // on the I/O thread
  virtual void dropped(const Dropped&) {}    // on the I/O thread
  virtual void started(const Received&) {}   // when an act leaves the queue, on the thread that prepares it
  virtual void answered(const Answered&) {}  // on the I/O thread
  /// Whether `in` and `out` are wanted of acts of other protocols too, for which they are made.
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
