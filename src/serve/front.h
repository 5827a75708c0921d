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

class Io;

/// The answer of the engine to an act.
struct Reply {
  const ActRequest& request;
  ActionChunk chunk;  // `timing` has the server's own stages in it
  double queue_ms;    // that the act waited
};

/// An act and its answer as serialized v1::Request and v1::Response.
struct Record {
  std::string request, response;
};

/// One request of a client, in the protocol of its front end: how it is decoded and answered. One thread at a time.
class Call {
 public:
  virtual ~Call() = default;
  /// The act that it is, with its images decoded. On the thread that prepares. Errors: bad_request, too_large,
  /// bad_observation.
  virtual Result<ActRequest> decode(const ServedPolicy& policy) = 0;
  /// The chunk's bytes. On the thread that computes.
  virtual std::string encode(Reply reply, const ServedPolicy& policy) = 0;
  /// The refusal's bytes. On the I/O thread, as what follows.
  virtual std::string encode(const Error& error) = 0;
  /// Hands an answer to the socket. A client that is gone, or that does not read, does not get it.
  virtual void send(const std::string& answer) = 0;
  /// Frees what it holds, and tells the client that there is no memory for its answer, if there is any for that.
  virtual void send_out_of_memory() noexcept = 0;
  /// The request where it is a serialized v1::Request; null in other protocols.
  virtual const net::Bytes* native() const { return nullptr; }
};

/// A request on its way through the server.
struct Job : Received {
  std::unique_ptr<Call> call;
  std::string policy_name;                   // as the client gives it; empty for the only one or the default
  std::shared_ptr<ServedPolicy> policy;      // that answers, once it is in line
  net::Share share;                          // whose turn it is
  std::optional<std::uint64_t> deadline_ms;  // from its receipt: when its turn has to have come
  std::optional<Clock::time_point> deadline;
};

/// A protocol: the sockets that it listens at, what it answers itself, and the calls that it hands to `Io::submit`. It
/// knows no architecture; what a policy takes is in the description.
class Front {
 public:
  virtual ~Front() = default;
  /// The bound addresses, ports filled in.
  virtual std::vector<std::string> addresses() const = 0;
  /// The policy of acts that name none, before `begin`. Errors: usage where the protocol cannot carry what it takes.
  virtual Status serve(const ServedPolicy& policy) = 0;
  /// Another version took its place: it differs in nothing but bundle and runtime. On the I/O thread.
  virtual void replaced(const v1::Description&) {}
  /// The names that its clients give, and their conventions, for people; empty where they are the policy's own.
  virtual std::string told() const { return {}; }
  /// Takes connections from now on; called before every turn of the loop.
  virtual void begin(Io& io) = 0;
  /// Whether an answer has not left yet.
  virtual bool has_answers() const = 0;
};

}  // namespace vla::serve
