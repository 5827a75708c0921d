// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <span>
#include <string>
#include <vector>

#include "net/bytes.h"
#include "net/eviction.h"
#include "observe/observer.h"
#include "serve/act.h"
#include "serve/policies.h"
#include "wire/vla.pb.h"

namespace vla::serve {

using observe::Answered, observe::Dropped, observe::Health, observe::Observer, observe::Received;
using wire::Kind, wire::kind_name;

class Io;

/// The answer of the engine to an act.
struct Reply {
  const ActRequest& request;
  ActionChunk chunk;  // `timing` includes the server's stages
  double queue_ms;    // time that the act waited
};

/// An act and its answer as serialized v1::Request and v1::Response.
struct Record {
  std::string request, response;
};

/// One request of a client in its protocol: decodes it and encodes its answer. One thread at a time uses it.
class Call {
 public:
  virtual ~Call() = default;
  /// Decodes the act with its images. On the preparing thread. Errors: bad_request, too_large, bad_observation.
  virtual Result<ActRequest> decode(const ServedPolicy& policy) = 0;
  /// Encodes the chunk. On the computing thread.
  virtual std::string encode(Reply reply, const ServedPolicy& policy) = 0;
  /// Encodes a refusal. This function, `send` and `send_out_of_memory` run on the I/O thread.
  virtual std::string encode(const Error& error) = 0;
  /// Sends an answer, unless the client is gone or does not read.
  virtual void send(const std::string& answer) = 0;
  /// Frees its memory, and reports to the client that memory ran out, if that is possible.
  virtual void send_out_of_memory() noexcept = 0;
  /// The request, if it is a serialized v1::Request; null in other protocols.
  virtual const net::Bytes* native() const { return nullptr; }
};

/// A request on its way through the server.
struct Job : Received {
  std::unique_ptr<Call> call;
  std::string policy_name;                   // name that the client gave; empty for the only policy or the default
  std::shared_ptr<ServedPolicy> policy;      // the policy that answers, once it is queued
  net::Share share;                          // for fairness between peers
  std::optional<std::uint64_t> deadline_ms;  // milliseconds from receipt within which it must start
  std::optional<Clock::time_point> deadline;
};

/// A protocol: it owns its listening sockets, answers what needs no engine, and passes calls to `Io::submit`. It knows
/// no architecture; the description lists a policy's inputs.
class Front {
 public:
  virtual ~Front() = default;
  /// The bound addresses with their ports.
  virtual std::vector<std::string> addresses() const = 0;
  /// Sets the policy for acts that name none; call it before `begin`. Errors: usage, if the protocol cannot carry the
  /// policy's inputs.
  virtual Status serve(const ServedPolicy& policy) = 0;
  /// Another version replaced the policy; only bundle and runtime differ. On the I/O thread.
  virtual void replaced(const v1::Description&) {}
  /// The names that clients send, and their conventions, as a text for people; empty if they are the policy's own.
  virtual std::string told() const { return {}; }
  /// Accepts connections from now on; called before every turn of the loop.
  virtual void begin(Io& io) = 0;
  /// Whether an answer is not sent yet.
  virtual bool has_answers() const = 0;
};

}  // namespace vla::serve
